"""The scenes that everything is measured on, rendered once per run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.bench import limit
from tactflow.sim import Scene, Truth, open_scene
from tactflow.sim.markers import DARK_MARKER, EDGE
from tactflow.vision.geometry import PixelMapping


@dataclass(frozen=True, slots=True)
class Case:
    """A scene and how much of it is used.

    name : of the scene. frames : of its recording, all of which are used. query : further settings.
    suffix : tells it from the same scene with other settings.
    """

    name: str
    frames: int
    query: str = ""
    suffix: str = ""

    @property
    def label(self) -> str:
        """What results call it."""
        return self.name + self.suffix

    @property
    def spec(self) -> str:
        """What `open_scene` is given."""
        return f"{self.name}?frames={self.frames}" + (f"&{self.query}" if self.query else "")


QUICK = (Case("press", 44), Case("bright_cable", 40), Case("jumps", 30))
"""One contact with each kind of light, and the hardest motion."""

FULL = (
    Case("press", 150),
    Case("bright", 150),
    Case("mixed", 100),
    Case("cable", 280),
    Case("bright_cable", 220),
    Case("bent_cable", 100),
    Case("edge", 150),
    Case("box", 150),
    Case("ring", 80),
    Case("screw", 80),
    Case("two", 80),
    Case("border", 150),
    Case("slide", 140),
    Case("twist", 140),
    Case("strong_shear", 140),
    Case("jumps", 160),
    Case("worn", 150),
    Case("jumps", 160, "worn=0.05&missing=0.05&vanish=0.05", "_worn"),
    Case("dense", 100),
    Case("sparse", 80),
    Case("bright_dots", 80),
    Case("square_dots", 80),
    Case("doubled_dots", 80),
    Case("irregular", 80),
    Case("tilted", 80),
    Case("glossy", 100),
    Case("noisy", 100),
    Case("drift", 150),
    Case("flicker", 150),
    Case("idle", 100),
    Case("tap", 100),
    Case("unmarked", 100),
)
"""Every kind of contact, light, marker and camera trouble."""

TROUBLES = (
    Case("warm_up", 140),
    Case("stale", 100),
    Case("lamp", 100),
    Case("round_gel", 56),
    Case("block", 56),
    Case("coin", 56),
    Case("key", 56),
    Case("long_edge", 56),
    Case("finger", 56),
    Case("dark_channel", 56),
    Case("halo", 56),
    Case("painted", 56),
    Case("speckle", 56),
    Case("leds", 56),
    Case("stray", 56),
)
"""What went wrong on recordings of real gels, one trouble in each scene."""

QUICK_STAGES = (Case("press", 20), Case("bright_cable", 20), Case("jumps", 16))
"""For methods alone; short, because OpenCV's inpainting is slow."""

FULL_STAGES = (
    Case("press", 60),
    Case("bright", 60),
    Case("cable", 60),
    Case("bright_cable", 60),
    Case("twist", 60),
    Case("strong_shear", 60),
    Case("jumps", 60),
    Case("worn", 60),
    Case("dense", 60),
    Case("noisy", 60),
    Case("drift", 60),
)

NOMINAL = frozenset(
    {"press", "bright", "mixed", "cable", "bright_cable", "box", "slide", "twist", "border", "two", "dense"}
)
"""Scenes at noise 2 with a sound gel and steady light: what the targets speak of."""


class Rendered:
    """A rendered scene: raw frames in a `.npy` file, truth on demand.

    Parameters
    ----------
    case : which scene. folder : where the file goes.
    """

    def __init__(self, case: Case, folder: Path) -> None:
        self.case = case
        self.scene: Scene = open_scene(case.spec)
        self.path = folder / f"{case.label}-{case.frames}.npy"
        size = (case.frames, self.scene.size[1], self.scene.size[0], 3)
        frames = np.lib.format.open_memmap(self.path, mode="w+", dtype=np.uint8, shape=size)
        for index in range(case.frames):
            frames[index] = self.scene.frame(index)
        frames.flush()
        self.frames: NDArray[np.uint8] = frames
        self._truths: dict[Any, list[Truth]] = {}

    def __len__(self) -> int:
        return self.case.frames

    def truths(self, mapping: PixelMapping) -> list[Truth]:
        """The truth about every frame, in the coordinates of a mapping; computed once per mapping."""
        key = (mapping.size, mapping.matrix.tobytes())
        if key not in self._truths:
            self._truths[key] = [self.scene.truth(index, mapping) for index in range(len(self))]
        return self._truths[key]

    def deep(self, index: int) -> bool:
        """Whether something is pressed to at least half of its depth."""
        # The smooth ramp passes through half depth; a hair of tolerance keeps that frame on one side.
        return any(press.depth >= 0.5 * press.shape.depth - 1e-9 for press in self.scene.presses(index))

    def displacement_limit(self, mapping: PixelMapping) -> float | None:
        """Cramer-Rao bound of a displacement's RMS length in processed px; None where it does not apply.

        For round dark dots of a camera whose only trouble is noise. The bound belongs to the raw frame: no
        processing can add information.
        """
        settings = self.scene.settings
        plain = settings.shape == "round" and settings.polarity == "dark" and self.scene.camera.identity
        plain = plain and not settings.sizes and not settings.aperture
        if not plain or settings.noise <= 0 or settings.blur or settings.jpeg or settings.shot:
            return None
        layout = self.scene.layout
        inside = np.all((layout.rest >= 0) & (layout.rest < self.scene.size), axis=1)
        if not inside.any():
            return None
        x, y = np.rint(layout.rest[inside]).astype(int).T
        light = self.scene.clean(0)[np.minimum(y, 599), np.minimum(x, 799)].astype(np.float64)
        contrast = DARK_MARKER * light * layout.contrast[inside, None]
        noise = limit.rounded(settings.noise)
        variance = [limit.position_bound(layout.radius, EDGE, row, noise) ** 2 for row in contrast]
        raw = limit.displacement_bound(math.sqrt(float(np.mean(variance))))
        scale = math.sqrt(abs(float(np.linalg.det(mapping.matrix[:2, :2]))))
        return raw * scale


def render_all(cases: tuple[Case, ...], folder: Path) -> Iterator[Rendered]:
    """Render one scene after the other; each file is removed when the next one is asked for."""
    for case in cases:
        rendered = Rendered(case, folder)
        try:
            yield rendered
        finally:
            rendered.path.unlink(missing_ok=True)
