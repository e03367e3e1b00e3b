"""The simulated scenes that everything is measured on, rendered once per run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.sim import Scene, Truth, open_scene
from tactflow.sim.camera import SIZE
from tactflow.vision.geometry import PixelMapping


@dataclass(frozen=True, slots=True)
class Case:
    """A scene and how much of it is used.

    Attributes
    ----------
    name : of the scene.
    frames : of its recording, all of which are used.
    query : further settings.
    suffix : distinguishes it from the same scene with other settings.
    """

    name: str
    frames: int
    query: str = ""
    suffix: str = ""

    @property
    def label(self) -> str:
        """Its name in results."""
        return self.name + self.suffix


def _cases(text: str) -> tuple[Case, ...]:
    """Cases written as NAME:FRAMES."""
    pairs = (word.split(":") for word in text.split())
    return tuple(Case(name, int(frames)) for name, frames in pairs)


QUICK = _cases("press:44 bright_cable:40 jumps:30")
"""One contact with each kind of light, and the hardest motion."""

FULL = (
    *_cases("press:150 bright:150 mixed:100 cable:280 bright_cable:220 edge:150 box:150"),
    *_cases("ring:80 screw:80 two:80 border:150 slide:140 twist:140 strong_shear:140 jumps:160 worn:150"),
    Case("jumps", 160, "worn=0.05&missing=0.05&vanish=0.05", "_worn"),
    *_cases("dense:100 bright_dots:80 square_dots:80 doubled_dots:80 irregular:80 tilted:80"),
    *_cases("noisy:100 drift:150 flicker:150 idle:100 tap:100 unmarked:100"),
)
"""Every kind of contact, light, marker and camera trouble."""

TROUBLES = (
    *_cases("lamp:100 round_gel:56 block:56 coin:56 long_edge:56 finger:56 dark_channel:56"),
    *_cases("halo:56 painted:56 stray:56"),
)
"""What went wrong on recordings of real gels, one trouble in each scene."""

QUICK_STAGES = _cases("press:10 bright_cable:10 jumps:10")
"""For methods alone; short, because OpenCV's inpainting is slow."""

FULL_STAGES = _cases(
    "press:60 bright:60 cable:60 bright_cable:60 twist:60 strong_shear:60 jumps:60 worn:60 dense:60 noisy:60 "
    "drift:60"
)


class Rendered:
    """A rendered scene: raw frames in a `.npy` file, truth on demand.

    Parameters
    ----------
    case : which scene.
    folder : where the file goes.
    size : (width, height) of the frames, px.
    """

    def __init__(self, case: Case, folder: Path, size: tuple[int, int] = SIZE) -> None:
        self.case = case
        self.scene: Scene = open_scene(f"{case.name}?frames={case.frames}&{case.query}".rstrip("&"))
        self.path = folder / f"{case.label}-{case.frames}.npy"
        shape = (case.frames, size[1], size[0], 3)
        self.frames = np.lib.format.open_memmap(self.path, mode="w+", dtype=np.uint8, shape=shape)
        for index in range(case.frames):
            self.frames[index] = self.render(index)
        self.frames.flush()
        self._truths: dict[Any, list[Truth]] = {}

    def render(self, index: int) -> NDArray[np.uint8]:
        """The raw frame, (H, W, 3) uint8 BGR."""
        return self.scene.frame(index)

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
        # The smooth ramp passes through half depth; the tolerance keeps that frame on one side.
        return any(press.depth >= 0.5 * press.shape.depth - 1e-9 for press in self.scene.presses(index))


@contextmanager
def rendered(case: Case, folder: Path) -> Iterator[Rendered]:
    """Render a scene for the block, after which its file is removed."""
    scene = Rendered(case, folder)
    try:
        yield scene
    finally:
        scene.path.unlink(missing_ok=True)
