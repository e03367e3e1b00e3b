"""The simulated sensor, made to look like the one that is tuned for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.scenes import Case, Rendered
from tactflow.doctor import measures
from tactflow.doctor.observation import Observation
from tactflow.drawing.jpeg import encode_jpeg
from tactflow.sim import Truth, open_scene
from tactflow.sim.camera import SIZE
from tactflow.tune.recording import Recording, change_between
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.markers import NoMarkersError, detect_markers

Image = NDArray[np.uint8]

OWN_BLUR: Final = 0.9
"""Blur of the simulator's own dots as the doctor measures it, px of its frame."""
DOT_LIMITS: Final = (1.5, 60.0)
"""Radii of a dot that the simulator is asked for, px of its frame. Chosen by hand."""
COLUMNS: Final = 60
"""Columns and rows of dots that the simulator draws at most."""
LIGHTS: Final = {"photometric": 0.0, "mixed": 0.5, "bright": 1.0}
"""Light of the simulator -> how much its contacts brighten all channels alike, 0 to 1."""
DEPTHS: Final = (0.3, 0.5, 0.75, 1.0)
"""Depths of the simulated press, relative, among which the one with the change of the recording is taken."""
NOISES: Final = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
"""Noises that are tried under JPEG, grey levels."""
FAINT: Final = 0.06
"""Change of the light, relative, from which on a place tells how the light of a contact changes. By hand."""


@dataclass(frozen=True)
class Look:
    """How the simulator is set to look like a sensor.

    size : (width, height) of its frames, px. query : settings of the scene, as `open_scene` takes them.
    noise : grey levels. blur : px of its frames, on top of the simulator's own. jpeg : quality, 0 for none.
    levels : (3,) factors of the simulator's light, BGR. contrast : of the dots, relative to the simulator's.
    """

    size: tuple[int, int]
    query: str
    noise: float = 0.0
    blur: float = 0.0
    jpeg: int = 0
    levels: tuple[float, ...] = (1.0, 1.0, 1.0)
    contrast: float = 1.0

    def __str__(self) -> str:
        parts = [f"{self.size[0]} x {self.size[1]} px", f"noise {self.noise:.1f} grey levels", self.query]
        if self.contrast != 1.0:
            parts.append(f"dots of {100 * self.contrast:.0f} % contrast")
        if self.blur:
            parts.append(f"blur {self.blur:.1f} px")
        if self.jpeg:
            parts.append(f"JPEG of quality {self.jpeg}")
        return ", ".join(parts)


def fit(recording: Recording) -> Look:
    """Settings with which the simulator looks like a recording.

    The simulator's frames keep their shape of 4 : 3 and get as many pixels as the sensor's; so dots and
    noise have the size, in pixels, that they have there.
    """
    seen = recording.seen
    scale = math.sqrt(recording.size[0] * recording.size[1] / (SIZE[0] * SIZE[1]))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    plain = Look(size, f"{_dots(seen, scale)}&light={_light_of(recording)}")
    own = compressed(light(plain, open_scene(f"press?{plain.query}&frames=60&noise=0"), 0), 0)
    levels = tuple(float(v) for v in _levels(seen.pairs[0].image) / np.maximum(_levels(own), 1.0))
    jpeg = 0 if seen.jpeg_step is None else round(measures.jpeg_quality(seen.jpeg_step))
    noise = _noise_before(recording, jpeg) if jpeg else measures.noise_of(seen.pairs)
    blur = measures.blur(seen.typical) or 0.0
    return Look(
        size,
        f"{plain.query}&depth={_depth(recording, plain, own)}",
        round(noise, 2),
        round(math.sqrt(max(blur**2 - (OWN_BLUR * scale) ** 2, 0.0)), 2),
        jpeg,
        levels,
        round(_contrast_ratio(seen, own, levels), 2),
    )


def _dots(seen: Observation, scale: float) -> str:
    """The settings of the simulator's dots. scale : px of the sensor for one of the simulator."""
    dots = seen.dots
    if dots is None:
        return "markers=none"
    missing = measures.lattice(dots, seen.typical).missing
    pitch = min(dots.pitch / scale, 400.0)
    radius = float(np.clip(min(dots.dot_radius / scale, 0.4 * pitch), *DOT_LIMITS))
    columns, rows = (int(np.clip(side // pitch, 1, COLUMNS)) for side in SIZE)
    grid = f"markers={columns}x{rows}&pitch={pitch:.2f}&dot={radius:.2f}&polarity={dots.polarity}"
    return f"{grid}&missing={min(missing, 0.5):.3f}"


def _noise_before(recording: Recording, jpeg: int) -> float:
    """Noise, grey levels, of which JPEG leaves as much from frame to frame as the recording shows."""
    pairs = [pair for pair in recording.seen.pairs if pair.after is not None]
    wanted = float(
        np.median([measures.temporal_noise(p.image, p.after) for p in pairs if p.after is not None])
    )
    plain = np.asarray(cv2.GaussianBlur(recording.seen.pairs[0].image, (0, 0), 2.0), np.float32)
    rng = np.random.default_rng(0)
    left = []
    for noise in NOISES:
        frames = [compressed(plain + noise * rng.standard_normal(plain.shape), jpeg) for _ in range(2)]
        left.append(measures.temporal_noise(*frames))
    return float(np.interp(wanted, np.maximum.accumulate(left), NOISES))


def compressed(light: NDArray[Any], jpeg: int) -> Image:
    """(H, W, 3) grey levels as uint8, after JPEG of a quality; 0 is none."""
    image = np.asarray(np.clip(np.rint(light), 0, 255), np.uint8)
    if not jpeg:
        return image
    data = np.frombuffer(encode_jpeg(image, jpeg), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _levels(image: Image) -> NDArray[np.float64]:
    """(3,) median of the gel's channels, BGR."""
    gel = image[image.max(axis=2) > measures.BLACK]
    return np.asarray(np.median(gel, axis=0) if len(gel) else np.ones(3), np.float64)


def _contrast_ratio(seen: Observation, own: Image, levels: tuple[float, ...]) -> float:
    """Contrast of the dots, relative to that of the simulator's dots (`own`) under as much light."""
    if seen.dots is None:
        return 1.0
    own = np.clip(own * np.array(levels), 0, 255).astype(np.uint8)
    try:
        dots = detect_markers(own)
    except NoMarkersError:
        return 1.0
    theirs = measures.lattice(seen.dots, seen.grays[0]).contrast
    return float(np.clip(theirs / max(measures.lattice(dots, measures.grey(own)).contrast, 1.0), 0.1, 1.1))


def _light_of(recording: Recording) -> str:
    """Which of the simulator's lights answers to a contact as the recording does."""
    untouched, touched = _extremes(recording)
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


def _extremes(recording: Recording) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The untouched picture and the one in which most has changed, of those kept; (h, w, 3), smoothed."""
    pairs = recording.seen.pairs
    first = pairs[0].image
    most = max(pairs, key=lambda pair: recording.changes[pair.number])
    side = max(8, min(first.shape[:2]) // 60)
    small = [cv2.blur(image, (side, side))[::4, ::4].astype(np.float32) for image in (first, most.image)]
    return small[0], small[1]


def _depth(recording: Recording, plain: Look, own: Image) -> float:
    """Depth of the simulated press whose light changes as much as that of the recording.

    own : the simulated gel before it is touched.
    """
    wanted = max(recording.changes)
    found = {}
    for depth in DEPTHS:
        scene = open_scene(f"press?{plain.query}&frames=60&noise=0&depth={depth}")
        deepest = max(range(60), key=lambda index: max((p.depth for p in scene.presses(index)), default=0.0))
        found[depth] = change_between(own, compressed(light(plain, scene, deepest), 0))
    return min(found, key=lambda depth: abs(math.log(max(found[depth], 1e-3) / wanted)))


def light(look: Look, scene: Any, index: int) -> NDArray[np.float32]:
    """A frame of the sensor's size, light and contrast of dots, in grey levels (H, W, 3).

    They are not rounded: rounded before the noise is added, they have steps in which nothing changes, and the
    contact's centre is off by half as much again.
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
    """A simulated recording that looks like the sensor, with its truth.

    look : of the sensor. case : scene and length; its query is added to the look's. folder : for its frames.
    seed : of the noise.
    """

    def __init__(self, look: Look, case: Case, folder: Path, seed: int) -> None:
        self.case = case
        query = "&".join(part for part in (look.query, case.query, "noise=0", f"seed={seed}") if part)
        self.scene = open_scene(f"{case.name}?frames={case.frames}&{query}")
        self.path = folder / f"{case.label}-{seed}.npy"
        width, height = look.size
        shape = (case.frames, height, width, 3)
        self.frames = np.lib.format.open_memmap(self.path, mode="w+", dtype=np.uint8, shape=shape)
        rng = np.random.default_rng([seed, 0x7475])
        for index in range(case.frames):
            frame = light(look, self.scene, index)
            if look.blur:
                frame = np.asarray(cv2.GaussianBlur(frame, (0, 0), look.blur), np.float32)
            frame += np.float32(look.noise) * rng.standard_normal(frame.shape, dtype=np.float32)
            self.frames[index] = compressed(frame, look.jpeg)
        self.frames.flush()
        self._truths: dict[Any, list[Truth]] = {}
        self._scale = width / SIZE[0], height / SIZE[1]

    def truths(self, mapping: PixelMapping) -> list[Truth]:
        """As `Rendered.truths`, in the coordinates of a mapping from the sensor's frames."""
        sx, sy = self._scale
        shrink = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return super().truths(PixelMapping(SIZE, mapping.size, mapping.matrix @ shrink))
