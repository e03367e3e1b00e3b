"""The force from what is seen of contacts: fitted to a gauge's CSV, tried on forces it has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactflow.calibration.force import fit_force
from tactflow.calibration.force_samples import Watched
from tactflow.calibration.reference import Reference, read_reference, time_offset
from tactflow.engine.errors import ConfigError
from tactflow.vision.force import Seen

STIFFNESS = {"volume": 1.5, "depth_by_width": 0.8, "area": 0.0}
SHEAR = {"shear_by_area": 0.2, "shear_by_width": 0.0}
NOISE = 0.1
"""Relative error of the features that are seen."""


def session(seed: int, presses: int = 6) -> tuple[Watched, Reference]:
    """Presses of several sizes at 60 Hz, and the gauge that was read at 100 Hz beside them."""
    rng = np.random.default_rng(seed)
    times = np.arange(presses * 60 + 30) / 60
    depth, drag = np.zeros(len(times)), np.zeros(len(times), complex)
    width = np.ones(len(times))
    for number in range(presses):
        part = slice(30 + 60 * number, 70 + 60 * number)
        swing = np.sin(np.linspace(0, np.pi, 42))[1:-1]
        depth[part] = rng.uniform(0.3, 1) * swing
        width[part] = rng.uniform(1, 4)
        drag[part] = rng.uniform(0.1, 0.5) * swing * np.exp(2j * np.pi * rng.uniform())
    true = {"volume": depth * width**2 / 2, "depth_by_width": depth * width, "area": width**2 * (depth > 0)}
    moved = {"shear_by_area": drag * width**2, "shear_by_width": drag * width}
    fz = sum(STIFFNESS[name] * values for name, values in true.items())
    shear = sum(SHEAR[name] * values for name, values in moved.items())
    gauge = np.arange(0, times[-1], 0.01)
    force = np.stack([np.interp(gauge, times, part) for part in (shear.real, shear.imag, fz)], axis=1)
    # One error for each moment: a contact that is seen too large has too large a volume.
    error = 1 + NOISE * rng.standard_normal(len(times))
    touched = depth > 0
    seen = Watched(
        np.arange(len(times), dtype=float),
        times,
        {name: values * error for name, values in true.items()},
        {name: values * error for name, values in moved.items()},
        touched,
        np.zeros(len(times)),
        0.0,
    )
    return seen, Reference("gauge.csv", gauge, False, force)


def sessions(seeds: range) -> tuple[dict[str, Watched], dict[str, Reference]]:
    """Several of them, by name."""
    made = {str(seed): session(seed) for seed in seeds}
    return {name: one[0] for name, one in made.items()}, {name: one[1] for name, one in made.items()}


def test_the_stated_errors_of_forces_that_the_fit_has_not_seen_are_honest() -> None:
    fit = fit_force(*sessions(range(4)))
    model = fit.entry.model()
    assert fit.entry.left_out == "recording"
    assert fit.entry.press.r2 > 0.95
    assert model.drag is not None
    errors, stated = [], []
    for seed in range(10, 20):
        seen, gauge = session(seed)
        for i in np.flatnonzero(seen.touched):
            press = {name: float(values[i]) for name, values in seen.press.items()}
            drag = {name: (float(v[i].real), float(v[i].imag)) for name, v in seen.drag.items()}
            force = model.force(Seen(press, drag))
            true = [np.interp(seen.times[i], gauge.time, part) for part in gauge.force.T]
            errors.append(np.array(force.value, float) - true)
            stated.append(force.stderr)
    for axes in (slice(0, 2), slice(2, 3)):
        ratio = np.abs(np.array(errors)[:, axes] / np.array(stated, float)[:, axes])
        assert 0.61 <= np.mean(ratio < 1) <= 0.75
        assert 0.91 <= np.mean(ratio < 2) <= 0.99


def test_recordings_of_one_object_are_left_out_together() -> None:
    watched, references = sessions(range(4))
    things = ("ball_1.avi", "ball_2.avi", "cube.mcap", "key 3.mcap")
    by_object = fit_force(
        dict(zip(things, watched.values(), strict=True)), dict(zip(things, references.values(), strict=True))
    )
    assert by_object.entry.left_out == "object"
    assert by_object.entry.press.stiffness == fit_force(watched, references).entry.press.stiffness
    two = {name: watched[name] for name in ("0", "1")}
    assert fit_force(two, {name: references[name] for name in two}).entry.left_out == "press"


def test_a_clock_that_is_ahead_and_a_gauge_that_is_turned_are_noticed() -> None:
    watched, references = sessions(range(3))
    late = references["1"]
    turned = {
        name: replace(one, force=one.force[:, [1, 0, 2]] * (1, -1, 1)) for name, one in references.items()
    }
    turned["1"] = replace(turned["1"], time=late.time - 0.317)
    fit = fit_force(watched, turned)
    assert fit.entry.recordings["1"] == fit.offsets["1"].seconds == pytest.approx(0.317, abs=0.004)
    assert 0 < fit.offsets["1"].stderr < 0.004
    assert fit.entry.recordings["0"] == pytest.approx(0, abs=0.004)
    # What is y of the picture was called x: its x axis points down.
    assert fit.turned == pytest.approx(-90, abs=1)
    assert not fit.mirrored
    plain = fit_force(watched, references).entry.drag
    assert plain is not None
    assert fit.entry.drag is not None
    assert fit.entry.drag.stiffness == pytest.approx(plain.stiffness, rel=0.02)


def test_the_error_of_a_clock_covers_how_far_it_is_off() -> None:
    off = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        times = np.arange(300) / 60
        starts = np.cumsum(rng.uniform(0.3, 1.4, 5))
        press = sum(rng.uniform(0.5, 1) * np.exp(-(((times - at) / 0.15) ** 2)) for at in starts)
        # Noise that lasts for several frames, as that of a contact's outline.
        noise = 0.2 * np.convolve(rng.standard_normal(310), np.ones(11) / 11**0.5, "valid")
        features = np.where(press > 0.01, press * (1 + noise), 0)[:, None]
        force = np.stack([press, press, 5 * press], axis=1)
        found = time_offset(Reference("gauge.csv", times, False, force), times, times, features)
        off.append(found.seconds / found.stderr)
    assert 0.5 < np.mean(np.abs(off) < 1) < 0.85
    assert np.mean(np.abs(off) < 2) > 0.85


def test_a_change_of_the_whole_gel_beyond_that_at_rest_is_learned_as_a_force() -> None:
    watched, references = sessions(range(3))
    rng = np.random.default_rng(5)
    by_change = {
        name: replace(
            one,
            press={"root_change": one.press["volume"]},
            change=np.where(one.touched, one.press["volume"], rng.normal(0, 0.1, len(one.times))),
        )
        for name, one in watched.items()
    }
    entry = fit_force(by_change, references).entry
    # The largest hundredth of a normal distribution.
    assert entry.least_change == pytest.approx(0.233, abs=0.08)
    assert fit_force(watched, references).entry.least_change is None


def test_a_gauge_with_one_axis_that_writes_zeros_for_the_others_gives_no_drag() -> None:
    watched, references = sessions(range(3))
    upright = {name: replace(one, force=one.force * (0, 0, 1)) for name, one in references.items()}
    fit = fit_force(watched, upright)
    assert fit.entry.drag is None
    assert fit.entry.press == fit_force(watched, references).entry.press


CHANGES: dict[str, Callable[[Reference], dict[str, np.ndarray]]] = {
    r"time runs from 100 to .* --offset": lambda gauge: {"time": gauge.time + 100},
    "its sign is turned": lambda gauge: {"force": -gauge.force},
    "does not follow the contact": lambda gauge: {
        "force": np.roll(gauge.force, 330, axis=0) * np.linspace(1, 0, len(gauge.time))[:, None]
    },
}


@pytest.mark.parametrize("words", CHANGES)
def test_a_reference_of_another_recording_is_refused(words: str) -> None:
    watched, references = sessions(range(3))
    references["0"] = replace(references["0"], **CHANGES[words](references["0"]))
    with pytest.raises(ConfigError, match=words):
        fit_force(watched, references)


def test_too_few_presses_and_recordings_without_any_are_refused() -> None:
    seen, gauge = session(0, presses=2)
    with pytest.raises(ConfigError, match=r"required 4 presses or more .* found 2 in 1 recordings"):
        fit_force({"a.avi": seen}, {"a.avi": gauge})
    idle = replace(seen, touched=np.zeros_like(seen.touched))
    with pytest.raises(ConfigError, match=r"a\.avi: nothing touches the gel"):
        fit_force({"a.avi": idle}, {"a.avi": gauge})


@pytest.mark.parametrize(
    ("header", "change", "words"),
    [
        ("when,fz", None, r"missing t \(s\) or frame, found when, fz"),
        ("t,weight", None, r"missing fz \(N\)"),
        ("t,fz,fx", None, r"missing fy \(N\)"),
        ("t,fz", {7: "0.7,nan"}, r"line 9: fz: required a number, got 'nan'"),
        ("t,fz", {7: "0.7"}, r"line 9: fz: required a number, got ''"),
        ("t,fz", {7: "0.2,1"}, "line 9: t does not grow"),
        ("t,fz", {i: f"{i},2.5" for i in range(30)}, "2.5 N all along"),
        ("t,fz", dict.fromkeys(range(25), ""), "required 10 lines of force or more, found 5"),
    ],
)
def test_a_csv_that_is_no_reference_is_refused_with_its_line(
    header: str, change: dict[int, str] | None, words: str, tmp_path: Path
) -> None:
    lines = [f"{i / 10},{i},{i}" for i in range(30)]
    for number, line in (change or {}).items():
        lines[number] = line
    path = tmp_path / "gauge.csv"
    path.write_text("\n".join([header, *lines]))
    with pytest.raises(ConfigError, match=words):
        read_reference(path)
