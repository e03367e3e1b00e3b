"""The long stress: press and release, for hours of a sensor's life, and nothing may creep.

One cycle of press and release is rendered once and played again and again through the whole pipeline, each
time with fresh noise. Every block of frames shows the same motions, so its numbers can be compared with those
of any other block: marker error, lost markers, CPU time of a frame, and the memory of the process.
"""

from __future__ import annotations

import math
import mmap
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.engine.contract import Source
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline
from tactflow.sim import Scene, open_scene
from tactflow.vision.types import MarkerStatus

CYCLE = 120
"""Frames from one press to the next showing of the same one: 2 s at 60 Hz. Chosen by hand."""
BLOCKS = 20
"""Parts that a run is judged by. Chosen by hand."""
NOISE = 2.0
"""Standard deviation of the fresh noise, grey levels. Chosen by hand."""
LARGEST_GROWTH = 16.0
"""Memory by which a run may grow after its first tenth, MB: what the allocator needs to settle; a leak of one
processed frame in a hundred would be 360 MB in 100 000 frames."""
LARGEST_SLOWDOWN = 1.25
"""CPU time of the last blocks over that of the first: a processor's clock varies by a tenth or two."""
_SIGNIFICANT = 4.0
"""Standard errors by which a marker error has risen; chosen by hand."""
_NEGLIGIBLE = 0.01
"""Part of its own size by which the error may rise, and part of the markers by which more may be lost, in any
case; chosen by hand."""


@dataclass(slots=True)
class Block:
    """What one part of the run showed.

    frames : how many. errors : RMS error of the displacement of the seen markers, px, one number a cycle.
    lost : share of markers called lost, 0..1. cpu_ms : mean CPU time of a frame, its fresh noise included.
    memory_mb : of the process at the end of the block.
    """

    frames: int = 0
    errors: list[float] = field(default_factory=list[float])
    lost: float = 0.0
    cpu_ms: float = 0.0
    memory_mb: float = 0.0

    @property
    def error(self) -> float:
        """Mean of the errors of its cycles, px; NaN with none."""
        return float(np.mean(self.errors)) if self.errors else math.nan


@dataclass(frozen=True, slots=True)
class Drift:
    """The blocks of a run, in order."""

    blocks: Sequence[Block]

    def complaints(self) -> list[str]:
        """What crept; empty where nothing did."""
        tenth = max(1, len(self.blocks) // 10)
        first, last = self.blocks[:tenth], self.blocks[-tenth:]
        found = []
        before = np.concatenate([block.errors for block in first])
        after = np.concatenate([block.errors for block in last])
        rise = float(after.mean() - before.mean())
        chance = math.sqrt(float(before.var()) / len(before) + float(after.var()) / len(after))
        if rise > max(_SIGNIFICANT * chance, _NEGLIGIBLE * float(before.mean())):
            found.append(f"marker error rose from {before.mean():.4f} to {after.mean():.4f} px")
        if last[-1].lost > first[0].lost + _NEGLIGIBLE:
            found.append(f"lost markers rose from {100 * first[0].lost:.1f} to {100 * last[-1].lost:.1f} %")
        growth = last[-1].memory_mb - first[-1].memory_mb
        if growth > LARGEST_GROWTH:
            found.append(f"memory grew by {growth:.1f} MB; required at most {LARGEST_GROWTH:g}")
        slower = float(np.mean([b.cpu_ms for b in last]) / np.mean([b.cpu_ms for b in first]))
        if slower > LARGEST_SLOWDOWN:
            found.append(f"a frame takes {slower:.2f} times as long; required at most {LARGEST_SLOWDOWN:g}")
        return found

    def rows(self) -> Iterator[tuple[str, str, str, str, str]]:
        """Frames so far, error, lost, CPU time and memory of each block, to be printed."""
        done = 0
        for block in self.blocks:
            done += block.frames
            yield (
                f"{done}",
                f"{block.error:.4f} px",
                f"{100 * block.lost:.2f} %",
                f"{block.cpu_ms:.2f} ms",
                f"{block.memory_mb:.1f} MB",
            )


def measure_drift(
    pipeline: Pipeline,
    frames: int = 100_000,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    *,
    blocks: int = BLOCKS,
) -> Drift:
    """Play press and release through a pipeline and watch what creeps.

    Parameters
    ----------
    pipeline : as loaded, with a tracker; its source is replaced.
    frames : rounded up so that each block holds as many whole cycles.
    progress : called with what is done, frames done, frames in total.
    blocks : number of parts; the first tenth of them is compared with the last.

    Raises
    ------
    ConfigError : the pipeline gives no markers. TactflowError : it failed.
    """
    cycles = max(2, math.ceil(frames / (CYCLE * blocks)))
    total = cycles * CYCLE * blocks
    scene = open_scene(f"press?frames={CYCLE}&noise=0")
    progress("rendering", 0, total)
    pictures = [scene.frame(index) for index in range(CYCLE)]
    run = LockstepPipeline(_endless(pipeline, pictures, total), None)
    try:
        truth: _Truth | None = None
        found = []
        for number in range(blocks):
            block = Block()
            spent: list[float] = []
            lost = seen = 0
            for _ in range(cycles):
                squares: list[NDArray[np.float64]] = []
                for index in range(CYCLE):
                    outcome = run.step()
                    if outcome is None or outcome.markers is None:
                        raise ConfigError(f"{pipeline.file}: required a pipeline that gives markers")
                    spent.append(outcome.cpu)
                    truth = truth or _Truth(scene, outcome)
                    squares.append(truth.squared_errors(outcome, index))
                    lost += int(np.count_nonzero(outcome.markers.status == MarkerStatus.LOST))
                    seen += len(outcome.markers.status)
                together = np.concatenate(squares)
                if together.size:
                    block.errors.append(float(np.sqrt(together.mean())))
                block.frames += CYCLE
                progress("press and release", number * cycles * CYCLE + block.frames, total)
            block.lost = lost / max(seen, 1)
            block.cpu_ms = 1e3 * float(np.mean(spent))
            block.memory_mb = memory_mb()
            found.append(block)
        return Drift(found)
    finally:
        run.close()


class _Truth:
    """Where each marker of the pipeline ought to be, in each frame of the cycle."""

    def __init__(self, scene: Scene, first: Outcome) -> None:
        assert first.markers is not None
        if first.mapping is None:
            raise ConfigError("required a pipeline that gives the mapping of its pixels (stage preprocess)")
        moved = []
        origin = np.zeros((0, 2))
        for index in range(CYCLE):
            origin, position = (first.mapping.to_processed(points) for points in scene.markers(index))
            moved.append(position - origin)
        away = np.hypot(*(first.markers.origin[:, None] - origin[None]).transpose(2, 0, 1))
        self._index = away.argmin(axis=1)
        self._moved = moved

    def squared_errors(self, outcome: Outcome, index: int) -> NDArray[np.float64]:
        """Squared error of the displacement of every marker that is not lost, px^2."""
        assert outcome.markers is not None
        error = outcome.markers.displacement - self._moved[index][self._index]
        known = outcome.markers.status != MarkerStatus.LOST
        return np.asarray((error[known] ** 2).sum(axis=1), np.float64)


def _endless(pipeline: Pipeline, pictures: Sequence[NDArray[np.uint8]], total: int) -> Pipeline:
    """The pipeline with a source that plays the pictures again and again, with fresh noise."""

    class Endless(Source):
        description = "press and release"

        def __init__(self, params: Any) -> None:
            super().__init__(params)
            self.total = total

        def frames(self) -> Iterator[Frame]:
            random = np.random.default_rng(1)
            size = pictures[0].size
            grain = np.rint(random.normal(0, NOISE, 2 * size)).astype(np.int16)
            for seq in range(total):
                start = int(random.integers(size))
                rough = grain[start : start + size].reshape(pictures[0].shape)
                image = np.asarray(cv2.add(pictures[seq % CYCLE], rough, dtype=cv2.CV_8U), np.uint8)
                image.flags.writeable = False
                yield Frame("stress", seq, seq / 60, image, time.perf_counter(), reference=seq == 0)

    source = pipeline.source
    nodes = dict(pipeline.nodes)
    nodes[source.id] = replace(source, component=replace(source.component, cls=Endless))
    return replace(pipeline, nodes=nodes)


def memory_mb() -> float:
    """What the process holds in memory now, MB: on macOS its largest so far, on Windows NaN."""
    if sys.platform == "linux":
        return memory_of(Path("/proc/self/statm").read_text())
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return math.nan


def memory_of(statm: str) -> float:
    """Memory of a process, MB, from what Linux says in `/proc/PID/statm`: its second number, in pages."""
    return int(statm.split()[1]) * mmap.PAGESIZE / 2**20
