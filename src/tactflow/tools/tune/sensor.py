"""Fit the simulated sensor to a recording: size, dots, brightness, blur and noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.recording.course import BLACK_GREY
from tactflow.sim import Truth, open_scene
from tactflow.sim.camera import SIZE
from tactflow.tools.bench.scenes import Case, Rendered
from tactflow.tools.doctor import measures
from tactflow.tools.doctor.observation import Observation
from tactflow.tools.tune.recording import Recording
from tactflow.vision.arrays import ColorImage
from tactflow.vision.geometry import PixelMapping

SIMULATOR_BLUR_PX: Final = 0.9
"""Intrinsic blur of the simulator's dots as the doctor measures it, px of its frame."""
DOT_RADIUS_LIMITS_PX: Final = (1.5, 60.0)
"""Range of dot radii passed to the simulator, px of its frame. Chosen by hand."""
MAX_COLUMNS: Final = 60
"""Maximum number of columns and rows of dots in the simulator."""


@dataclass(frozen=True)
class Look:
    """Simulator settings that reproduce the look of a sensor.

    Attributes
    ----------
    size : (width, height) of the frames, px.
    query : scene settings, as for `open_scene`.
    noise : grey levels.
    blur : px, in addition to the simulator's own.
    levels : (3,) factors on the simulator's light, BGR.
    """

    size: tuple[int, int]
    query: str
    noise: float = 0.0
    blur: float = 0.0
    levels: tuple[float, ...] = (1.0, 1.0, 1.0)

    def __str__(self) -> str:
        width, height = self.size
        noise, blur = f"noise {self.noise:.1f} grey levels", f"blur {self.blur:.1f} px"
        return f"{width} x {height} px, {noise}, {blur}, {self.query}"


def fit(recording: Recording) -> Look:
    """Fit the simulator to a recording.

    Its frames keep the aspect ratio 4 : 3 and get as many pixels as the sensor's, so that dots and noise have
    the same size in pixels.
    """
    observation = recording.observation
    scale = math.sqrt(recording.size[0] * recording.size[1] / (SIZE[0] * SIZE[1]))
    query = _dots(observation, scale)
    simulated = open_scene(f"press?{query}&frames=60&noise=0").frame(0)
    levels = _levels(observation.pairs[0].image) / np.maximum(_levels(simulated), 1.0)
    blur = measures.blur(observation.typical) or 0.0
    return Look(
        (round(SIZE[0] * scale), round(SIZE[1] * scale)),
        query,
        round(measures.noise_of(observation.pairs), 2),
        round(math.sqrt(max(blur**2 - (SIMULATOR_BLUR_PX * scale) ** 2, 0.0)), 2),
        tuple(map(float, levels)),
    )


def _dots(observation: Observation, scale: float) -> str:
    """Query for the simulator's dots. scale : sensor pixels per simulator pixel."""
    dots = observation.dots
    if dots is None:
        return "markers=none"
    missing = measures.lattice(dots, observation.typical).missing
    pitch = min(dots.pitch / scale, 400.0)
    radius = float(np.clip(min(dots.dot_radius / scale, 0.4 * pitch), *DOT_RADIUS_LIMITS_PX))
    columns, rows = (int(np.clip(side // pitch, 1, MAX_COLUMNS)) for side in SIZE)
    grid = f"markers={columns}x{rows}&pitch={pitch:.2f}&dot={radius:.2f}&polarity={dots.polarity}"
    return f"{grid}&missing={min(missing, 0.5):.3f}"


def _levels(image: ColorImage) -> NDArray[np.float64]:
    """Median grey levels (3,) of the gel, BGR."""
    gel = image[image.max(axis=2) > BLACK_GREY]
    return np.asarray(np.median(gel, axis=0) if len(gel) else np.ones(3), np.float64)


class Fitted(Rendered):
    """A simulated recording with the look of the sensor, and its truth.

    Parameters
    ----------
    case : scene and length; its query extends that of the look.
    folder : for the frames.
    seed : for the noise.
    """

    def __init__(self, look: Look, case: Case, folder: Path, seed: int) -> None:
        self._look, self._rng = look, np.random.default_rng([seed, 0x7475])
        query = "&".join(part for part in (look.query, case.query, "noise=0", f"seed={seed}") if part)
        super().__init__(replace(case, query=query), folder, look.size)

    def render(self, index: int) -> ColorImage:
        """The frame, with the sensor's size, light, blur and noise."""
        look = self._look
        image: NDArray[Any] = self.scene.frame(index).astype(np.float32)
        if look.size != SIZE:
            shrinks = look.size[0] < SIZE[0]
            image = cv2.resize(image, look.size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        # Not rounded: quantisation before adding noise increases the error of the contact's centre by half.
        frame = np.asarray(image * np.array(look.levels, np.float32), np.float32)
        if look.blur:
            frame = np.asarray(cv2.GaussianBlur(frame, (0, 0), look.blur), np.float32)
        frame += np.float32(look.noise) * self._rng.standard_normal(frame.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(frame), 0, 255), np.uint8)

    def truths(self, mapping: PixelMapping) -> list[Truth]:
        """Like `Rendered.truths`, for a mapping from frames of the sensor's size."""
        sx, sy = np.divide(self._look.size, SIZE)
        shrink = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return super().truths(PixelMapping(SIZE, mapping.size, mapping.matrix @ shrink))
