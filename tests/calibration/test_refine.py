"""A calibration of another sensor of the kind, made that of this one by a few presses of a ball."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tactflow
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration, ScaleEntry, raw_corners, small_picture
from tactflow.calibration.judgement import doubt
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Session
from tactflow.calibration.refine import apparent_radius, refine_photometry
from tactflow.calibration.samples import press_errors, summary
from tactflow.engine.errors import ConfigError
from tactflow.sim import open_scene
from tactflow.sim.light import LIGHTS
from tactflow.vision.depth.slopes import SlopeModel
from tests.calibration.ball_presses import BALL, noisy, scale, session_of
from tests.terminal import Terminal

SCALE = scale()


@pytest.fixture(scope="module")
def base() -> Calibration:
    """The calibration of a simulated sensor."""
    session = session_of(open_scene("ball?frames=500"))
    fitted = fit_photometry(session, SCALE, BALL)
    return Calibration(
        sensor="main",
        made_from="sim:ball",
        raw_size=session.mapping.raw_size,
        size=session.mapping.size,
        corners=raw_corners(session.mapping),
        scale=ScaleEntry.of(SCALE, "known"),
        photometric=fitted.found,
        look=small_picture(session.untouched),
        slopes=fitted.model,
        information=fitted.information,
    )


@pytest.fixture(scope="module")
def other() -> Session:
    """Presses on another sensor of the kind: its lamps are lower, and stand elsewhere."""
    first = LIGHTS["photometric"]
    lamps = replace(first, slope_gain=(2.2, 2.0, 2.4), azimuth=(333.0, 86.0, 209.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LIGHTS, "photometric", lamps)
        return session_of(open_scene("ball?frames=500&seed=3"))


def some(session: Session, which: slice) -> Session:
    """Some of the presses."""
    return replace(session, presses=session.presses[which])


def errors(model: SlopeModel | None, session: Session) -> dict[str, float]:
    """Errors on every second press, of which none is refined from."""
    assert model is not None
    return summary(press_errors(some(session, slice(1, None, 2)), model, SCALE, BALL))


def test_each_press_brings_the_slopes_of_another_sensor_nearer(base: Calibration, other: Session) -> None:
    presses = some(other, slice(0, None, 2))
    found = [errors(base.slopes, other)]
    for count in (1, 3, 9):
        refined = refine_photometry(some(presses, slice(count)), SCALE, BALL, base)
        assert refined.found.presses == count
        found.append(errors(refined.model, other))
    before, one, three, nine = ([e[name] for name in ("normal_error", "depth_stderr")] for e in found)
    assert before[0] > 2.5
    assert before[1] > 0.12
    assert one[0] < 0.6 * before[0]
    assert one[1] < 0.4 * before[1]
    assert three[0] < 0.5 * before[0]
    assert three[1] < 0.2 * before[1]
    assert nine[0] < 0.35 * before[0]


def test_stated_errors_after_one_press_hold_on_the_others(base: Calibration, other: Session) -> None:
    assert base.photometric is not None
    wider = base.photometric.model_copy(update={"depth_stderr": 0.11, "between": 0.102})
    known = base.model_copy(update={"photometric": wider})
    refined = refine_photometry(some(other, slice(1)), SCALE, BALL, known)
    found = errors(refined.model, other)
    assert found["depth_stderr"] < refined.found.depth_stderr < wider.depth_stderr
    assert refined.found.between == pytest.approx(wider.between / 2)


def test_presses_that_are_no_ball_are_refused(base: Calibration, other: Session) -> None:
    swapped = [replace(p, image=np.ascontiguousarray(p.image[..., ::-1])) for p in other.presses]
    with pytest.raises(ConfigError, match="the object is not a ball, nothing touches the gel"):
        refine_photometry(replace(other, presses=swapped[:3]), SCALE, BALL, base)
    idle = [replace(p, image=noisy(other.untouched, p.seq)) for p in other.presses]
    with pytest.raises(ConfigError, match="nothing touches the gel"):
        fit_photometry(replace(other, presses=idle), SCALE, BALL)


def test_a_fit_from_scratch_is_kept_where_it_is_the_better_one(base: Calibration, other: Session) -> None:
    presses = some(other, slice(0, None, 2))
    # A base whose slopes are right only in the mean.
    assert base.slopes is not None
    rng = np.random.default_rng(0)
    odd = base.slopes.coefficients.copy()
    odd[1:] += rng.normal(0, 0.5 * np.abs(odd[:1]).max(), odd[1:].shape).astype(np.float32)
    worse = base.model_copy(update={"slopes": SlopeModel(odd)})
    fresh = fit_photometry(presses, SCALE, BALL)
    refined = refine_photometry(presses, SCALE, BALL, worse)
    assert np.array_equal(refined.model.coefficients, fresh.model.coefficients)
    few = some(presses, slice(2))
    kept = refine_photometry(few, SCALE, BALL, base)
    assert kept.found.normal_error <= fit_photometry(few, SCALE, BALL).found.normal_error


def test_a_press_that_is_no_ball_is_left_out_among_others(base: Calibration, other: Session) -> None:
    odd = replace(other.presses[1], image=np.roll(other.presses[1].image, 1, axis=2))
    presses = [other.presses[0], odd, *other.presses[2:4]]
    refined = refine_photometry(replace(other, presses=presses), SCALE, BALL, base)
    assert refined.kept.tolist() == [True, False, True, True]
    assert (refined.found.presses, refined.found.rejected) == (3, 1)


def test_a_diameter_in_place_of_the_radius_is_asked_about(base: Calibration, other: Session) -> None:
    few = some(other, slice(4))
    right = apparent_radius(few, SCALE, BALL, base)
    assert doubt(few, SCALE, BALL, right) is None
    seen = apparent_radius(few, SCALE, 2 * BALL, base)
    assert seen == pytest.approx(right, rel=0.15)
    question = doubt(few, SCALE, 2 * BALL, seen)
    assert question is not None
    assert "not its diameter" in question
    assert f"about {seen:.2g} mm" in question
    # Without another calibration, contacts that a ball of half the radius could make raise the question.
    contact = float(np.median([press.radius for press in other.presses])) * SCALE.x
    assert doubt(other, SCALE, contact) is None
    question = str(doubt(other, SCALE, BALL))
    assert "which fits both" in question
    assert "press deeper" not in question
    assert "if that is right, press deeper" in str(doubt(other, SCALE, 4 * BALL))


def pictures_of(folder: Path, untouched: str, presses: Sequence[str], to: Path) -> Path:
    """A folder with links to some pictures, the untouched gel first."""
    to.mkdir()
    for number, name in enumerate((untouched, *presses)):
        (to / f"{number}.png").symlink_to(folder / name)
    return to


def test_another_mini_has_depth_by_the_default_and_says_once_that_it_is_one(
    shared_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = shared_data / "mini_ball_9mm"
    names = sorted(path.name for path in folder.glob("*.png") if path.name != "background.png")[::8]
    source = pictures_of(folder, "background.png", names, tmp_path / "presses")
    with caplog.at_level(logging.INFO, "tactflow"):
        results = list(tactflow.stream("mini_plain", source=str(source), images=True))
    known = Calibration.load(KINDS / "mini.yaml").photometric
    assert known is not None
    stated = f"depth +- {100 * known.depth_stderr:.0f} %, lengths +- 5 %"
    assert caplog.text.count(f"default calibration of a GelSight Mini: {stated}") == 1
    deep = [result for result in results if result.depth]
    assert len(deep) == len(names)
    for result in deep:
        assert result.depth is not None
        assert result.scale is not None
        assert result.contact_mask is not None
        radius = float(np.sqrt(np.count_nonzero(result.contact_mask) / np.pi)) * result.scale.x
        cap = 4.735 - np.sqrt(4.735**2 - radius**2)
        # Around the ball the gel sinks, too: Sneddon's half-space twice as much as the cap, a thin layer not.
        assert 0.8 * cap < result.depth.greatest < 2.2 * cap


def test_edges_of_a_cube_are_refused_as_presses_of_a_ball(
    shared_data: Path, tmp_path: Path, terminal: Terminal
) -> None:
    folder = shared_data / "gels" / "mini_box"
    names = sorted(path.name for path in folder.glob("*.png"))
    source = pictures_of(folder, names[0], names[1:], tmp_path / "presses")
    words = ["calibrate", "mini_plain", "--from", str(source), "--ball-radius", "3"]
    for how in (["--refine"], ["--area", "20.3", "15.2"]):
        assert terminal(*words, *how) == 2
        assert "those of a ball are round" in terminal.err
    assert not list(tmp_path.rglob("*.yaml"))


def test_a_digit_has_depth_after_one_press_of_a_ball(
    shared_data: Path, tmp_path: Path, terminal: Terminal
) -> None:
    folder = shared_data / "digit_ball"
    source = pictures_of(folder, "000.png", ["002.png"], tmp_path / "press")
    words = ["calibrate", "digit", "--from", str(source), "--refine", "--ball-radius", "4.4"]
    assert terminal(*words, "--out", "mine.yaml") == 0
    assert "1 press; learning from it" in terminal.err
    assert "more presses, all over the gel, make it better" in terminal.err
    others = pictures_of(folder, "000.png", ["005.png", "012.png"], tmp_path / "others")
    results = list(tactflow.stream("digit", source=str(others), settings={"calibration": "mine.yaml"}))
    depths = [result.depth.greatest for result in results if result.depth]
    assert len(depths) == 2
    assert all(0.3 < depth < 4.4 for depth in depths)
