"""Fit the simulated sensor to a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.scenes import Case, Rendered
from tactflow.doctor import measures
from tactflow.doctor.observation import Observation
from tactflow.sim import Truth, open_scene
from tactflow.sim.camera import SIZE
from tactflow.tune.recording import Recording, change_between
from tactflow.vision.arrays import ColorImage
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.markers import NoMarkersError, detect_markers

OWN_BLUR: Final = 0.9
"""Intrinsic blur of the simulator's dots as the doctor measures it, px of its frame."""
DOT_LIMITS: Final = (1.5, 60.0)
"""Range of dot radii passed to the simulator, px of its frame. Chosen by hand."""
MAX_COLUMNS: Final = 60
"""Maximum number of columns and rows of dots in the simulator."""
LIGHTS: Final = {"photometric": 0.0, "mixed": 0.5, "bright": 1.0}
"""Light of the simulator -> share of the change at a contact common to all channels, 0 to 1."""
DEPTHS: Final = (0.3, 0.5, 0.75, 1.0)
"""Relative depths of the simulated press among which the best match is selected."""
FAINT: Final = 0.06
"""Minimum relative change of light at pixels that decide the type of light. Chosen by hand."""


@dataclass(frozen=True)
class Look:
    """Simulator settings that reproduce the look of a sensor.

    size : (width, height) of the frames, px. query : scene settings, as for `open_scene`. noise : grey
    levels. blur : px, in addition to the simulator's own. levels : (3,) factors on the simulator's light,
    BGR. contrast : of the dots, relative to the simulator's.
    """

    size: tuple[int, int]
    query: str
    noise: float = 0.0
    blur: float = 0.0
    levels: tuple[float, ...] = (1.0, 1.0, 1.0)
    contrast: float = 1.0

    def __str__(self) -> str:
        parts = [f"{self.size[0]} x {self.size[1]} px", f"noise {self.noise:.1f} grey levels", self.query]
        if self.contrast != 1.0:
            parts.append(f"dots of {100 * self.contrast:.0f} % contrast")
        if self.blur:
            parts.append(f"blur {self.blur:.1f} px")
        return ", ".join(parts)


def fit(recording: Recording) -> Look:
    """Fit the simulator to a recording.

    Its frames keep the aspect ratio 4 : 3 and get as many pixels as the sensor's, so that dots and noise have
    the same size in pixels.
    """
    observation = recording.observation
    scale = math.sqrt(recording.size[0] * recording.size[1] / (SIZE[0] * SIZE[1]))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    plain = Look(size, f"{_dots(observation, scale)}&light={_light_of(recording)}")
    simulated = rounded(light(plain, open_scene(f"press?{plain.query}&frames=60&noise=0"), 0))
    levels = tuple(
        float(v) for v in _levels(observation.pairs[0].image) / np.maximum(_levels(simulated), 1.0)
    )
    noise = measures.noise_of(observation.pairs)
    blur = measures.blur(observation.typical) or 0.0
    return Look(
        size,
        f"{plain.query}&depth={_depth(recording, plain, simulated)}",
        round(noise, 2),
        round(math.sqrt(max(blur**2 - (OWN_BLUR * scale) ** 2, 0.0)), 2),
        levels,
        round(_contrast_ratio(observation, simulated, levels), 2),
    )


def _dots(observation: Observation, scale: float) -> str:
    """Query for the simulator's dots. scale : sensor pixels per simulator pixel."""
    dots = observation.dots
    if dots is None:
        return "markers=none"
    missing = measures.lattice(dots, observation.typical).missing
    pitch = min(dots.pitch / scale, 400.0)
    radius = float(np.clip(min(dots.dot_radius / scale, 0.4 * pitch), *DOT_LIMITS))
    columns, rows = (int(np.clip(side // pitch, 1, MAX_COLUMNS)) for side in SIZE)
    grid = f"markers={columns}x{rows}&pitch={pitch:.2f}&dot={radius:.2f}&polarity={dots.polarity}"
    return f"{grid}&missing={min(missing, 0.5):.3f}"


def rounded(light: NDArray[Any]) -> ColorImage:
    """(H, W, 3) uint8 from grey levels."""
    return np.asarray(np.clip(np.rint(light), 0, 255), np.uint8)


def _levels(image: ColorImage) -> NDArray[np.float64]:
    """Median grey levels (3,) of the gel, BGR."""
    gel = image[image.max(axis=2) > measures.BLACK]
    return np.asarray(np.median(gel, axis=0) if len(gel) else np.ones(3), np.float64)


def _contrast_ratio(observation: Observation, simulated: ColorImage, levels: tuple[float, ...]) -> float:
    """Contrast of the dots, relative to the dots of the simulated frame at the same light levels."""
    if observation.dots is None:
        return 1.0
    simulated = np.clip(simulated * np.array(levels), 0, 255).astype(np.uint8)
    try:
        dots = detect_markers(simulated)
    except NoMarkersError:
        return 1.0
    contrast = measures.lattice(dots, measures.grey(simulated)).contrast
    target = measures.lattice(observation.dots, observation.grays[0]).contrast
    return float(np.clip(target / max(contrast, 1.0), 0.1, 1.1))


def _light_of(recording: Recording) -> str:
    """The simulator's light that responds to contacts like the recording."""
    pictures = recording.observation.pairs[0].image, recording.pressed
    side = max(8, min(pictures[0].shape[:2]) // 60)
    untouched, touched = (cv2.blur(picture, (side, side))[::4, ::4].astype(float) for picture in pictures)
    ratio = (touched / np.maximum(untouched, 25.0)).reshape(-1, 3)
    ratio = ratio / np.maximum(np.median(ratio, axis=0), 0.1) - 1.0
    strong = ratio[np.abs(ratio).max(axis=1) > FAINT]
    if not len(strong):
        return "photometric"
    mean = strong.mean(axis=1)
    common = float(np.mean(mean) / max(float(np.mean(np.abs(strong))), 1e-6))
    if common < -0.6:
        return "darkening"
    return min(LIGHTS, key=lambda name: abs(LIGHTS[name] - max(common, 0.0)))


def _depth(recording: Recording, plain: Look, untouched: ColorImage) -> float:
    """Depth of the simulated press that changes the light as much as the recording.

    untouched : simulated frame of the untouched gel.
    """
    target = recording.change
    changes = {}
    for depth in DEPTHS:
        scene = open_scene(f"press?{plain.query}&frames=60&noise=0&depth={depth}")
        deepest = max(range(60), key=lambda index: max((p.depth for p in scene.presses(index)), default=0.0))
        changes[depth] = change_between(untouched, rounded(light(plain, scene, deepest)))
    return min(changes, key=lambda depth: abs(math.log(max(changes[depth], 1e-3) / target)))


def light(look: Look, scene: Any, index: int) -> NDArray[np.float32]:
    """A frame with the sensor's size, light levels and dot contrast, (H, W, 3) grey levels.

    Not rounded: quantisation before adding noise increases the error of the contact's centre by half.
    """
    image = scene.frame(index).astype(np.float32)
    if look.contrast != 1.0:
        clean = scene.clean(index).astype(np.float32)
        image = cv2.addWeighted(image, look.contrast, clean, 1.0 - look.contrast, 0.0)
    if look.size != SIZE:
        shrinks = look.size[0] < SIZE[0]
        image = cv2.resize(image, look.size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return np.asarray(image * np.array(look.levels, np.float32), np.float32)


class Fitted(Rendered):
    """A simulated recording with the look of the sensor, and its truth.

    case : scene and length; its query extends that of the look. folder : for the frames. seed : for the
    noise.
    """

    def __init__(self, look: Look, case: Case, folder: Path, seed: int) -> None:
        self._look, self._rng = look, np.random.default_rng([seed, 0x7475])
        query = "&".join(part for part in (look.query, case.query, "noise=0", f"seed={seed}") if part)
        super().__init__(replace(case, query=query), folder, look.size)

    def render(self, index: int) -> ColorImage:
        """The frame, with blur and noise."""
        frame = light(self._look, self.scene, index)
        if self._look.blur:
            frame = np.asarray(cv2.GaussianBlur(frame, (0, 0), self._look.blur), np.float32)
        frame += np.float32(self._look.noise) * self._rng.standard_normal(frame.shape, dtype=np.float32)
        return rounded(frame)

    def truths(self, mapping: PixelMapping) -> list[Truth]:
        """Like `Rendered.truths`, for a mapping from frames of the sensor's size."""
        sx, sy = np.divide(self._look.size, SIZE)
        shrink = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return super().truths(PixelMapping(SIZE, mapping.size, mapping.matrix @ shrink))
