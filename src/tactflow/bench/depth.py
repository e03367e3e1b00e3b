"""Heights in mm: calibrated on presses of a ball, tried on other contacts, and on a real ball."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.pipelines import on_recording
from tactflow.bench.recordings import stack
from tactflow.bench.results import RECORDING, Measurement
from tactflow.bench.timing import CopyUnit, Samples, timed
from tactflow.calibration.photometric import Photometry, fit_photometry
from tactflow.calibration.presses import Press, Session, find_presses
from tactflow.calibration.scale import centre
from tactflow.engine.graph import Pipeline
from tactflow.sim import Scene, open_scene
from tactflow.sim.elastic import MM
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

RAW_MM: Final = MM
"""Millimetres per raw pixel that the simulated gel is given."""
BALL: Final = 95 * RAW_MM
"""Radius of the ball of the scene `ball`, mm."""
LIGHTS: Final = ("photometric", "mixed", "dark_channel")
"""Lights of the simulator whose colours tell slopes; none is the polynomial that a calibration fits."""
SCENES: Final = ("press", "cable", "long_edge", "coin")
"""What presses: like the ball of the calibration, longer, sharper, and with steep steps."""
WEDGE_SCALE: Final = Scale(0.1, 0.1, (0.0, 0.0), centre((240, 320)))
"""What wedge_ball's readme says: about 0.1 mm a pixel."""
WEDGE_BALL: Final = 1.98
"""Radius of its ball, mm."""


def measure_simulated(unit: CopyUnit) -> list[Measurement]:
    """Calibrate on each light, and compare height maps with the surface that the simulator knows.

    unit : measured along the way.
    """
    made = []
    for light in LIGHTS:
        known = learn(f"ball?frames=600&light={light}")
        ratios: list[float] = []
        for name in SCENES:
            scene = open_scene(f"{name}?seed=11&light={light}")
            made.append(_tried(known, scene, Measurement("depth", light, name), unit, ratios))
        within = {f"depth_within_{name}": _share(ratios, bound) for name, bound in (("one", 1), ("two", 2))}
        made.append(Measurement("depth", light, "all", frames=len(ratios), errors=within))
    return made


def _share(ratios: list[float], bound: float) -> float:
    return 100 * float(np.mean(np.array(ratios) < bound))


def learn(spec: str) -> Photometry:
    """What a calibration learns from a simulated session."""
    return fit_photometry(session_of(open_scene(spec)), scale(), BALL)


def scale() -> Scale:
    """The true scale of the simulated gel in the default pipeline's processed frame."""
    return Scale(2 * RAW_MM, 2 * RAW_MM, (0.0, 0.0), centre(_preprocessor().mapping.size))


def session_of(scene: Scene) -> Session:
    """Every press of a scene at its deepest, with the true outline and without markers."""
    preprocess = _preprocessor()
    rest = scene.truth(0, preprocess).unmarked
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
    return Press(index, noisy(truth.unmarked, index), mask, np.zeros(mask.shape, np.bool_), center, radius)


def noisy(image: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """The picture with the noise of a camera whose frames were halved: one grey level."""
    noise = np.random.default_rng(seed).normal(0, 1, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _tried(
    known: Photometry, scene: Scene, measurement: Measurement, unit: CopyUnit, ratios: list[float]
) -> Measurement:
    preprocess = _preprocessor()
    rest = Rest(scene.truth(0, preprocess).unmarked)
    surface = Surface(known.model, scale(), known.found.errors())
    rms, volumes, samples = [], [], Samples()
    for index in deepest(scene):
        truth = scene.truth(index, preprocess)
        press = _press(scene, index, preprocess)
        unit.take()
        found = timed(partial(surface.depth, press.image, rest, press.mask), samples)
        sunk = truth.sunk * RAW_MM
        around = sunk > 0.02 * sunk.max()
        rms.append(float(np.sqrt(np.mean((found.heights - sunk)[around] ** 2)) / sunk.max()))
        assert found.greatest_stderr is not None
        ratios.append(abs(found.greatest - float(sunk.max())) / found.greatest_stderr)
        volumes.append(abs(found.volume / (float(sunk.sum()) * scale().area(1.0)) - 1))
    measurement.frames = len(rms)
    measurement.errors = {
        "depth_rms": 100 * float(np.mean(rms)),
        "volume_error": 100 * float(np.mean(volumes)),
    }
    measurement.copies = {"contact": 1e3 * float(np.median(samples.cpu)) / unit.copy_ms}
    return measurement


def measure_ball(wedge: Pipeline, folder: Path, scratch: Path) -> Measurement:
    """Errors of a calibration on the presses of wedge_ball, each half learned from the other.

    wedge : the pipeline of this sensor. folder : with `labels.csv`. scratch : for temporary files.
    """
    with (folder / "labels.csv").open(newline="", encoding="utf-8") as file:
        names = [row["file"] for row in csv.DictReader(file)]
    recording = stack([folder / "reference.jpg", *(folder / name for name in names)], scratch)
    found = fit_photometry(find_presses(on_recording(wedge, recording)), WEDGE_SCALE, WEDGE_BALL).found
    measurement = Measurement("depth", "wedge", f"{RECORDING}wedge_ball", frames=len(names))
    measurement.errors = {
        "normal_error": found.normal_error,
        "ball_radius_error": 100 * abs(found.radius_error),
        "sphere_rms": found.sphere_rms,
    }
    return measurement
