"""Short recordings whose truth is known, and what results on them are compared with."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.message.result import Result
from tactflow.sim import Scene, Truth, open_scene
from tactflow.tools.bench import metrics
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.scenes import Case
from tactflow.tools.bench.score import MarkerScore, add_decision, add_flow, add_geometry
from tactflow.vision.geometry import PixelMapping, Preprocessor
from tactflow.vision.types import Markers, MarkerStatus

Image = NDArray[np.uint8]
Matrix = NDArray[np.float64]

DEEP_SHARE: Final = 0.5
"""Share of its full depth from which a contact must be found, as in the bench."""


@dataclass(frozen=True)
class Clip:
    """Frames of a simulated scene at the size of processed frames, and where the truth about them lies.

    Attributes
    ----------
    scene : of the simulator.
    indices : its frames.
    frames : (H, W, 3) uint8 each; the first is the reference.
    matrices : (3, 3) for each frame, from the pixels of the plain clip to those of this one.
    """

    scene: Scene
    indices: tuple[int, ...]
    frames: tuple[Image, ...]
    mapping: PixelMapping
    matrices: tuple[Matrix, ...]

    def truth(self, number: int) -> tuple[Truth, bool]:
        """The truth about a frame, and whether its contact must be found."""
        height, width = self.frames[number].shape[:2]
        matrix = self.matrices[number] @ self.mapping.matrix
        index = self.indices[number]
        deep = any(p.depth >= DEEP_SHARE * p.shape.depth - 1e-9 for p in self.scene.presses(index))
        truth = _truth(self.scene, index, (width, height), matrix.tobytes())
        shift = (self.matrices[number] - self.matrices[0])[:2, 2]
        if shift.any():
            # Displacements are those since the reference, which lay elsewhere in the picture.
            truth, flow = copy(truth), truth.contact_flow
            truth.origin = truth.origin - shift
            truth.__dict__["contact_flow"] = (
                None if flow is None else (flow[0] + shift[0], flow[1] + shift[1])
            )
        return truth, deep

    def changed(self, frames: list[Image], matrices: list[Matrix] | None = None) -> Clip:
        """The same clip with other pictures."""
        return replace(self, frames=tuple(frames), matrices=tuple(matrices or self.matrices))

    def kept(self, numbers: list[int]) -> Clip:
        """Some frames of the clip."""
        return replace(
            self,
            indices=tuple(self.indices[number] for number in numbers),
            frames=tuple(self.frames[number] for number in numbers),
            matrices=tuple(self.matrices[number] for number in numbers),
        )

    @property
    def deepest(self) -> int:
        """The frame with the deepest contact."""
        return max(range(len(self.frames)), key=lambda number: self.truth(number)[0].depth)

    def score(self, results: list[Result]) -> dict[str, float]:
        """Key of the bench's quantities, or `SEEN_RMS` and `SILENT_PERCENT` -> error.

        Over all frames, but for contacts the first, which is the reference.
        """
        tally = Tally()
        dots, errors = MarkerScore(tally), DotErrors()
        for result in results:
            truth, deep = self.truth(result.seq)
            if result.markers is not None:
                dots.add(result.markers, truth)
                errors.add(result.markers, truth)
            if result.seq == 0:
                continue
            if add_decision(tally, result.contact is not None, truth, deep) and result.contact is not None:
                add_geometry(tally, result.contact, truth)
            add_flow(tally, result.flow, truth)
        return tally.errors() | errors.summary()


class DotErrors:
    """Errors of dots that a method says it sees, and of what it says about the others."""

    def __init__(self) -> None:
        self._seen: list[NDArray[np.float64]] = []
        self._silent: list[NDArray[np.bool_]] = []

    def add(self, markers: Markers, truth: Truth) -> None:
        """Add a frame. Dots belong together where they were nearest at rest."""
        if len(truth.origin) < 2 or len(markers.origin) == 0:
            return
        index = metrics.match_points(markers.origin, truth.origin, metrics.dot_pitch(truth.origin) / 2)
        found, own = index >= 0, index[index >= 0]
        moved = (truth.position - truth.origin)[found]
        errors = metrics.distance(markers.displacement[own], moved)
        status, stated = markers.status[own], markers.stderr[own]
        self._seen.append(errors[(status == MarkerStatus.TRACKED) & truth.visible[found]])
        # A dot that is inferred without a standard error is one of which nothing is claimed.
        unknown = np.where(status == MarkerStatus.TRACKED, 0.0, np.inf)
        claimed = SILENT_ERROR_STDERRS * np.where(np.isnan(stated), unknown, stated)
        lost = status == MarkerStatus.LOST
        self._silent.append((errors > SILENT_ERROR_PX) & (errors > claimed) & ~lost)

    def summary(self) -> dict[str, float]:
        """`SEEN_RMS` and `SILENT_PERCENT`, where there were dots."""
        seen = np.concatenate(self._seen) if self._seen else np.zeros(0)
        found = {SEEN_RMS: float(np.sqrt(np.mean(seen**2)))} if len(seen) else {}
        if self._silent:
            found[SILENT_PERCENT] = 100 * float(np.concatenate(self._silent).mean())
        return found


@lru_cache(maxsize=4096)
def _truth(scene: Scene, index: int, size: tuple[int, int], matrix: bytes) -> Truth:
    """Computed once for a frame and a mapping, and shared by all pipelines and perturbations."""
    mapping = PixelMapping(scene.size, size, np.frombuffer(matrix).reshape(3, 3))
    return scene.truth(index, mapping)


SEEN_RMS, SILENT_PERCENT = "seen_rms", "silent_percent"
"""RMS error of the displacement of dots that a method says it sees, px; share of dots that are wrong although
nothing says so, %."""
SILENT_ERROR_PX: Final = 1.0
"""Error of a dot from which it is wrong, px: half the width of the edge of a dot."""
SILENT_ERROR_STDERRS: Final = 4.0
"""Error, in stated standard errors, which they do not explain: 1 in 16,000 of normal errors."""

MARKED_CASES: Final = (Case("bright_cable", 40), Case("press", 44), Case("jumps", 40))
BARE_CASES: Final = (Case("unmarked", 44),)
"""Scenes for pipelines that track dots, and for those that do not. Every method sees the first one."""
STEP_FRAMES: Final = 2
"""Every second frame: contacts that come and go within a few frames, and half the work."""


def cases_for(*, dots: bool, count: int | None = None) -> tuple[Case, ...]:
    """The first scenes for a pipeline that tracks dots or does not. count : None for all."""
    return (MARKED_CASES if dots else BARE_CASES)[:count]


@lru_cache(maxsize=64)
def clip(case: Case, step: int = STEP_FRAMES) -> Clip:
    """Every `step`-th frame of a case, halved to 400 x 300 px."""
    scene = open_scene(f"{case.name}?frames={case.frames}&{case.query}".rstrip("&"))
    small = Preprocessor(scene.size, downsample=2)
    indices = tuple(range(0, case.frames, step))
    frames = []
    for index in indices:
        frames.append(np.ascontiguousarray(small(scene.frame(index))))
        frames[-1].flags.writeable = False
    eye = np.eye(3)
    return Clip(scene, indices, tuple(frames), small.mapping, (eye,) * len(frames))


@lru_cache(maxsize=8)
def clean(case: Case, number: int, *, dots: bool) -> NDArray[np.float64]:
    """A frame of a clip without noise, (H, W, 3) float64. dots : with its markers."""
    query = f"{case.name}?frames={case.frames}&{case.query}".rstrip("&")
    scene = open_scene(f"{query}&noise=0" if dots else query)
    index = number * STEP_FRAMES
    picture = scene.frame(index) if dots else scene.clean(index)
    half = (picture.shape[1] // 2, picture.shape[0] // 2)
    return np.asarray(cv2.resize(picture, half, interpolation=cv2.INTER_AREA), np.float64)
