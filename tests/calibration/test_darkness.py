"""Depth from darkening, learned from one press of a ball or more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tactflow
from tactflow.calibration.darkness import darkness_error, fit_darkness
from tactflow.calibration.presses import Press, Session
from tactflow.engine.errors import ConfigError
from tactflow.sim import open_scene
from tactflow.vision.depth.darkness import DarknessModel, DarkSurface
from tactflow.vision.depth.surface import Rest
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale
from tests.terminal import Terminal

MM, RADIUS = 0.05, 3.0
SCALE = Scale(MM, MM, (0.0, 0.0), (0.0, 0.0))
SIZE = (160, 120)
GEL = np.full((SIZE[1], SIZE[0], 3), 180, np.uint8)


def pressed(seq: int, depth: float, center: tuple[float, float] = (80.0, 60.0)) -> Press:
    """A ball in a thin gel, which loses half of its light per 0.7 mm of depth."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    distance = np.hypot(x - center[0], y - center[1]) * MM
    sunk = np.maximum(np.sqrt(np.maximum(RADIUS**2 - distance**2, 0)) - RADIUS + depth, 0)
    noise = np.random.default_rng(seq).normal(0, 1, GEL.shape)
    image = np.clip(np.rint(GEL * 0.5 ** (sunk / 0.7)[..., None] + noise), 0, 255).astype(np.uint8)
    mask = np.where(sunk > 0, 255, 0).astype(np.uint8)
    radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
    return Press(seq, image, mask, np.zeros(mask.shape, np.bool_), center, radius)


def session(*presses: Press) -> Session:
    """A session with these presses."""
    return Session(GEL, PixelMapping.identity(SIZE), list(presses), np.zeros((0, 2)), len(presses) + 1)


def test_one_press_of_a_ball_gives_the_depth_of_others_within_the_stated_error() -> None:
    fitted = fit_darkness(session(pressed(1, 0.6)), SCALE, RADIUS)
    assert fitted.found.stderr < 0.03
    surface, rest = DarkSurface(fitted.found.model(), SCALE, fitted.found.stderr), Rest(GEL)
    for number, depth in enumerate((0.3, 0.4, 0.55), 2):
        press = pressed(number, depth, (60.0, 70.0))
        found = surface.depth(press.image, rest, press.mask)
        assert found.greatest == pytest.approx(depth, abs=0.02)
        assert found.greatest_stderr == fitted.found.stderr
        cap = np.pi * depth**2 * (RADIUS - depth / 3)
        assert found.volume == pytest.approx(cap, rel=0.12)
        assert found.pressed <= found.volume


def test_deeper_than_any_press_the_error_is_not_known() -> None:
    fitted = fit_darkness(session(pressed(1, 0.6)), SCALE, RADIUS)
    deeper = pressed(2, 0.8)
    found = DarkSurface(fitted.found.model(), SCALE, fitted.found.stderr).depth(
        deeper.image, Rest(GEL), deeper.mask
    )
    assert found.greatest == pytest.approx(fitted.found.model().deepest)
    assert (found.greatest_stderr, found.volume_stderr) == (None, None)


def test_a_lighter_press_beside_a_deep_one_does_not_spoil_the_stated_error() -> None:
    fitted = fit_darkness(session(pressed(1, 0.6), pressed(2, 0.15)), SCALE, RADIUS)
    assert fitted.found.stderr < 0.02


def test_several_presses_are_judged_by_the_others() -> None:
    presses = [pressed(number, depth) for number, depth in enumerate((0.4, 0.6, 0.7))]
    fitted = fit_darkness(session(*presses), SCALE, RADIUS)
    assert fitted.found.presses == 3
    assert fitted.misfit.max() < 0.06
    today = session(pressed(7, 0.5))
    assert darkness_error(today, fitted.found, SCALE) < 0.04
    press = today.presses[0]

    def error(light: np.ndarray | float) -> float:
        lit = replace(press, image=(press.image * light).astype(np.uint8))
        return darkness_error(replace(today, presses=[lit]), fitted.found, SCALE)

    assert error(0.7) < 0.04, "exposure is no darkening"
    assert error(np.where(press.mask > 0, 0.7, 1.0)[..., None]) > 0.1


def test_a_gel_that_does_not_become_darker_is_refused() -> None:
    press = pressed(1, 0.6)
    brighter = replace(press, image=(360 - press.image.astype(np.int64)).clip(0, 255).astype(np.uint8))
    for image in (brighter.image, GEL):
        with pytest.raises(ConfigError, match="does not become darker"):
            fit_darkness(session(replace(press, image=image)), SCALE, RADIUS)
    with pytest.raises(ConfigError, match="nothing touched the gel"):
        fit_darkness(session(), SCALE, RADIUS)
    small = replace(press, radius=2.0)
    with pytest.raises(ConfigError, match="too small"):
        fit_darkness(session(small), SCALE, RADIUS)


@pytest.mark.parametrize("darkening", [[0.2, 0.2], [0.4, 0.2], [0.0, 0.4], [np.nan, 0.2], [0.2]])
def test_a_curve_that_does_not_increase_is_refused(darkening: list[float]) -> None:
    with pytest.raises(ValueError, match="increasing darkening and depth"):
        DarknessModel(darkening, [0.5, 1.0])


def test_the_command_learns_it_and_the_pipeline_has_depth(terminal: Terminal) -> None:
    gel = "light=absorbing&markers=none"
    command = ["calibrate", "markerless", "--from", f"sim:ball?frames=60&{gel}", "--area", "15", "20"]
    assert terminal(*command, "--darkness") == 2
    assert "required --ball-radius" in terminal.err
    assert terminal(*command, "--darkness", "--ball-radius", "2.375") == 0
    assert "% darker; standard error" in terminal.err
    spec = f"ball?frames=40&seed=3&{gel}"
    settings = {"calibration": "calibration/main.yaml"}
    scene = open_scene(spec)
    results = tactflow.stream("markerless", source=f"sim:{spec}", settings=settings)
    measured, true = np.transpose(
        [(r.depth.greatest, scene.truth(r.seq).sunk.max() * 0.025) for r in results if r.depth is not None]
    )
    deep = true > 0.2
    assert np.median(measured[deep] / true[deep]) == pytest.approx(1, abs=0.25)
    assert np.corrcoef(measured, true)[0, 1] > 0.97
    check = ["calibrate", "check", "calibration/main.yaml", "markerless", "--source", f"sim:{spec}"]
    assert terminal(*check) == 0
    output = terminal.out
    assert "mm RMS off" in output
    assert output.endswith("it still fits\n")
    dimmer = ["--source", "sim:ball?frames=40&light=bright&markers=none"]
    assert terminal(*check[:-2], *dimmer) == 3
    assert "mm RMS fit; few presses, a ball whose radius is not 2.375 mm" in terminal.out
