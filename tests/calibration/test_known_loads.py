"""A force calibration on another sensor of its kind, or on another day: known loads tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tactflow.calibration.file import Calibration
from tactflow.calibration.force import fit_force
from tactflow.calibration.known_loads import Gain, at_rest_of, carry, gain
from tactflow.calibration.session import learn_weights
from tactflow.calibration.weights import Weighed, fit_loads
from tactflow.engine.errors import ConfigError
from tactflow.vision.force import Seen
from tests.calibration.test_field_force import fitted
from tests.calibration.test_weights import session
from tests.calibrations import bare_calibration

FORCES = np.array([1.0, 2, 5, 8, 12, 16])


def calibrated(seed: int) -> Calibration:
    """One by six weights on a gel whose answer differs by a tenth from load to load."""
    seen, loads = session(seed, FORCES)
    return bare_calibration().model_copy(update={"force": fit_loads(seen, loads, FORCES.tolist()).entry})


def today(seed: int, forces: list[float], stiffness: float = 1.0) -> Weighed:
    """Known loads on a gel that is so many times as stiff as that of the calibration."""
    seen, loads = session(seed, np.array(forces) / stiffness)
    return Weighed(seen, loads, forces)


def test_two_presses_carry_a_force_to_a_stiffer_gel_with_an_honest_error() -> None:
    ratios = []
    for seed in range(60):
        other = calibrated(seed)
        made = carry(bare_calibration(), other, gain(other, today(500 + seed, [5.0, 15.0], stiffness=1.5)))
        assert made.force is not None
        rng = np.random.default_rng(seed)
        for force in rng.uniform(2, 20, 10):
            change = 4 * force / 1.5 * (1 + 0.1 * rng.normal())
            said = made.force.model().force(Seen({"root_change": change}, {}))
            assert said.stderr[2] is not None
            ratios.append((said.value[2] - force) / said.stderr[2])
    assert 0.6 < np.mean(np.abs(ratios) < 1) < 0.85
    assert 0.9 < np.mean(np.abs(ratios) < 2) < 1


def test_what_a_gel_shows_at_rest_is_not_carried_to_another_sensor() -> None:
    other, weighed = calibrated(1), today(500, [5.0, 15.0])
    seen = weighed.watched
    brighter = {"root_change": seen.press["root_change"] + 2.0 * seen.touched}
    noisy = weighed._replace(
        watched=replace(seen, press=brighter, change=seen.change + 2, change_at_rest=2.5)
    )
    plain_gel, noisy_gel = (
        carry(bare_calibration(), here, gain(here, loads))
        for loads in (weighed, noisy)
        for here in [at_rest_of(loads, other)]
    )
    assert plain_gel.force is not None
    assert noisy_gel.force is not None
    assert noisy_gel.force.change_at_rest == 2.5
    assert noisy_gel.force.pressing.range == pytest.approx(plain_gel.force.pressing.range)


def test_what_is_carried_is_scaled_in_all_its_parts() -> None:
    seen, known = fitted(1, 12)
    fit = fit_force({"a": seen}, {"a": known})
    other = bare_calibration().model_copy(update={"force": fit.entry, "field_force": fit.field})
    found = Gain(2.0, 0.2, np.ones(2), np.ones(2), np.ones(2))
    made = carry(bare_calibration(), other, found)
    assert made.force is not None
    assert other.force is not None
    assert made.field_force is not None
    assert fit.field is not None
    assert seen.field is not None
    assert made.field_force(seen.field[9]) == pytest.approx(2 * fit.field(seen.field[9]))
    before, after = other.force.dots["x"], made.force.dots["x"]
    assert after.error == pytest.approx((2 * before.error[0], math.hypot(before.error[1], 0.1)))
    assert after.range == pytest.approx(tuple(2 * limit for limit in before.range))
    with pytest.raises(ConfigError, match="required 2 loads or more, found 1"):
        carry(bare_calibration(), other, found._replace(known=np.ones(1)))


def test_a_gel_that_answers_otherwise_is_noticed_and_one_that_does_not_passes() -> None:
    same = [gain(calibrated(seed), today(300 + seed, [10.0])) for seed in range(40)]
    assert np.mean([found.is_one for found in same]) > 0.9
    softer = [gain(calibrated(seed), today(300 + seed, [5.0, 10, 15], 0.6)) for seed in range(40)]
    assert np.mean([found.is_one for found in softer]) < 0.2
    assert np.median([found.value for found in softer]) == pytest.approx(0.6, abs=0.05)


def test_the_address_of_a_camera_is_stored_without_its_password() -> None:
    lines: list[str] = []
    weighed = today(1, [2.0, 5.0, 12.0])
    made = learn_weights(bare_calibration(), weighed, "rtsp://me:secret@camera:554/1", lines.append)
    assert made.force is not None
    assert list(made.force.recordings) == ["rtsp://camera:554/..."]
    assert lines[0].startswith("force, 3 loads: RMS error")


def test_loads_that_cannot_be_compared_are_refused() -> None:
    weighed = today(1, [5.0])
    with pytest.raises(ConfigError, match="no load of known force"):
        gain(calibrated(1), weighed._replace(forces=[math.nan]))
    with pytest.raises(ConfigError, match="has no force part"):
        gain(bare_calibration(), weighed)
    seen, known = fitted(1, 12)
    fit = fit_force({"a": seen}, {"a": known})
    by_dots = bare_calibration().model_copy(update={"force": fit.entry, "field_force": fit.field})
    assert seen.field is not None
    wide = Weighed(replace(seen, field=seen.field[:, :-4]), [(8, 9)], [1.0])
    with pytest.raises(ConfigError, match="for pictures of another aspect ratio"):
        gain(by_dots, wide)
    heights = replace(weighed.watched, press={"volume": weighed.watched.change})
    with pytest.raises(ConfigError, match="heights are known here and not in the calibration"):
        gain(calibrated(1), weighed._replace(watched=heights))
    still = replace(weighed.watched, press={"root_change": 0 * weighed.watched.change})
    with pytest.raises(ConfigError, match="the calibration says no force for a load"):
        gain(calibrated(1), weighed._replace(watched=still))
