"""The least-squares similarity agrees with its plain version."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.flow.similarity import fit_similarity
from tests.oracles.similarity import plain_sum_similarity


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9, 40])
def test_sums_over_points_are_those_of_numpy(count: int) -> None:
    rng = np.random.default_rng(5)
    for on_a_line in (False, False, False, True):
        origin = rng.uniform(5, 150, (count, 2))
        if on_a_line:
            origin[:, 1] = origin[:, 0]
        position = origin + rng.normal(0, 2, (count, 2))
        chosen = np.flatnonzero(rng.random(count) < 0.8)
        if len(chosen) == 0:
            continue
        expected = np.empty(7)
        plain_sum_similarity(origin, position, chosen, expected)
        found = fit_similarity(np.asfortranarray(origin), position, chosen)
        assert found.fitted == bool(expected[2])
        # Derived: sums of 40 numbers of up to 2e2 px in doubles, in another order; squares of them.
        assert np.array(found)[:2] == pytest.approx(expected[:2], abs=1e-12)
        assert np.array(found)[3:5] == pytest.approx(expected[3:5], abs=1e-11)
        assert np.array(found)[5:] == pytest.approx(expected[5:], abs=1e-9)
