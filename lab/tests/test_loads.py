from __future__ import annotations

import numpy as np

from lab.loads import Loads as KnownLoads
from lab.loads import judge, lines
from tests.calibration.test_field_force import pictures, watched


def test_each_load_is_judged_by_the_others_beside_a_regression_on_the_mean_displacement() -> None:
    field, force = pictures(1, 9, each=2, scatter=0.02)
    loads = KnownLoads(watched(field), force, {})
    groups = np.repeat(np.arange(10), 2).astype(float)
    found = judge(loads, groups, force.any(axis=1))
    assert found["force"].shape == (18, 3)
    error, by_mean = (
        np.sqrt(np.square(found[name] - found["force"]).mean(axis=0)) for name in ("said", "by_mean")
    )
    assert (error < [0.2, 0.2, 0.5]).all()
    # A press only spreads the gel, which the mean does not show.
    assert by_mean[2] > 4
    upright = judge(loads, groups, force.any(axis=1), sideways=False)
    assert np.isnan(upright["said"][:, :2]).all()
    assert len(lines("a", found)) - len(lines("a", upright)) == 2
