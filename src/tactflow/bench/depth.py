"""Heights in mm: calibrated on presses of a ball, tried on other contacts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.pipelines import Bench
from tactflow.bench.quantities import Tally
from tactflow.calibration.photometric import Photometry, fit_photometry
from tactflow.calibration.presses import Press, Session
from tactflow.calibration.scale import centre
from tactflow.sim import Scene, open_scene
from tactflow.sim.gel import MM
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

DEPTH: Final = "depth"
"""Group of the rows about heights; the method is the light."""
RAW_MM: Final = MM
"""Millimetres per raw pixel that the simulated gel is given."""
BALL: Final = 95 * RAW_MM
"""Radius of the ball of the scene `ball`, mm."""
LIGHTS: Final = ("photometric", "mixed", "dark_channel")
"""Lights of the simulator whose colours tell slopes; none is the polynomial that a calibration fits."""
SCENES: Final = ("press", "cable", "long_edge", "coin")
"""What presses: like the ball of the calibration, longer, sharper, and with steep steps."""


def measure_simulated(bench: Bench) -> None:
    """Calibrate on each light, and compare height maps with the surface that the simulator knows."""
    for light in LIGHTS:
        photometry = fit_photometry(session_of(open_scene(f"ball?frames=600&light={light}")), scale(), BALL)
        coverage = Tally()
        for name in SCENES:
            tally = Tally()
            times = list(_compare(photometry, open_scene(f"{name}?seed=11&light={light}"), tally, coverage))
            bench.result.add(DEPTH, light, name, tally.errors(), times={"contact": times}, frames=len(times))
        bench.result.add(DEPTH, light, "all", coverage.errors())


def scale() -> Scale:
    """The true scale of the simulated gel in the default pipeline's processed frame."""
    return Scale(2 * RAW_MM, 2 * RAW_MM, (0.0, 0.0), centre(_preprocessor().mapping.size))


def session_of(scene: Scene) -> Session:
    """Every press of a scene at its deepest, with the true outline and without markers."""
    preprocess = _preprocessor()
    rest = preprocess(scene.clean(0))
    presses = [_press(scene, index, preprocess) for index in deepest(scene)]
    return Session(rest, preprocess.mapping, presses, np.zeros((0, 2)), len(scene))


def deepest(scene: Scene) -> list[int]:
    """The frame of each press in which it has come to its full depth."""
    depths = [max((press.depth for press in scene.presses(i)), default=0.0) for i in range(len(scene))]
    return [i for i in range(1, len(scene) - 1) if depths[i - 1] < depths[i] >= depths[i + 1]]


def _preprocessor() -> Preprocessor:
    return Preprocessor((800, 600), rotate=90, downsample=2)


def _press(scene: Scene, index: int, preprocess: Preprocessor) -> Press:
    truth = scene.truth(index, preprocess)
    mask = np.where(truth.contact_mask, 255, 0).astype(np.uint8)
    radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
    center = truth.center or (0.0, 0.0)
    image = noisy(preprocess(scene.clean(index)), index)
    return Press(index, image, mask, np.zeros(mask.shape, np.bool_), center, radius)


def noisy(image: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """The picture with the noise of a camera whose frames were halved: one grey level."""
    noise = np.random.default_rng(seed).normal(0, 1, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _compare(photometry: Photometry, scene: Scene, tally: Tally, coverage: Tally) -> Iterator[float]:
    """Compare the height map of each press; gives the CPU time of each, s.

    coverage : gets the errors of the greatest depth against their standard errors.
    """
    preprocess = _preprocessor()
    rest = Rest(preprocess(scene.clean(0)))
    surface = Surface(photometry.model, scale(), photometry.found.errors())
    for index in deepest(scene):
        press = _press(scene, index, preprocess)
        began = time.thread_time()
        depth = surface.depth(press.image, rest, press.mask)
        cpu_s = time.thread_time() - began
        sunk = scene.truth(index, preprocess).sunk * RAW_MM
        around = sunk > 0.02 * sunk.max()
        rms = np.sqrt(np.mean((depth.heights - sunk)[around] ** 2))
        volume = float(sunk.sum()) * scale().area(1.0)
        tally.add(depth_rms=100 * rms / sunk.max(), volume_error=100 * abs(depth.volume / volume - 1))
        assert depth.greatest_stderr is not None
        coverage.within("depth", depth.greatest - float(sunk.max()), depth.greatest_stderr)
        yield cpu_s
