"""What skipping costs and saves: a pipeline with it against the same pipeline without it, frame by frame.

Two runs of one pipeline take turns on the same frames; one has `skipping: false`. Wherever the skipping one
repeats a result, the other one has measured afresh, so the two numbers differ by the noise of two
measurements and by whatever moved in between without being noticed. Beside each difference stands the
number's own noise, taken from the run without skipping: from the second differences of three frames in a
row, in which slow motion cancels. Their deviation is sqrt(6) times that of one result, and the largest of
them is sqrt(3) times what two results differ by at most.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.pipelines import on_recording
from tactflow.bench.timing import CopyUnit, Samples, quiet
from tactflow.engine.graph import Pipeline
from tactflow.sim import open_scene, scene_names
from tactflow.sim.export import write_frames

NUMBERS = {"marker": "px", "center": "px", "area": "%", "angle": "deg", "flow": "px"}
"""The published numbers that are compared, and their units."""

SCENES = (*scene_names(), "hold?markers=none")
"""Every scene of the simulated sensor, and a still contact on a gel without markers."""


ADVERSARIES: Mapping[str, str] = {
    "drift": "light that grows by 18 % with a time constant of 5 s",
    "drift?drift=0.01": "light that grows by 1 % with a time constant of 5 s",
    "creep": "a contact that drags the gel by 0.02 px a frame",
    "flicker": "light that flickers by 6 %, with bands of gain of 3 %",
    "tap": "contacts of one frame",
    "spike": "contacts that come and go within five frames",
    "stutter": "frames that are delivered twice, and others that are missing",
    "border": "contacts that start at the frame's border",
    "two": "two contacts at once",
    "unmarked": "a contact that grows slowly on a gel without markers",
    "noisy": "a poor camera, in which small motions drown",
}
"""Scenes made to catch skipping out, and what they do."""

STALE = 1
"""Promise: frames in a row in which a number is further from a fresh one than noise takes it. A motion may
begin too faintly to be seen in its first frame."""

ALLOWED = 2.0
"""The RMS difference a repeated number may have, in standard deviations of one result: sqrt(2) is the noise
of two, the rest is for what moved too little to be noticed and for what few results say about an RMS."""
LARGEST = 1.5
"""A repeated number is stale where it differs by more than so many times what two fresh results differ by at
most: that is a largest value as well, and other frames of the same scene have another one."""

_SECOND_DIFFERENCE = math.sqrt(6)
"""Deviation of a second difference of three results over that of one; derived, see the top of this file."""

_LARGEST_BEND = math.sqrt(3)
"""Largest of the second differences over the largest difference of two results; derived, as above."""

_MEDIAN_DEVIATION = 0.6745
"""Median of the absolute value of a standard normal deviate."""
_OUTLIER = 5.0
"""Second differences above so many deviations are motion, not noise; chosen by hand."""
ENOUGH = 20
"""Differences from which a noise or an RMS is told: it is then known to about a fifth."""


@dataclass(frozen=True, slots=True)
class Noise:
    """What a number does although nothing moves.

    rms : standard deviation of one result. largest : what two results differ by at most.
    """

    rms: float
    largest: float


@dataclass(slots=True)
class Comparison:
    """One scene with and without skipping.

    repeated : frames whose result was repeated. rest : the longest run of such frames. decisions : frames in
    which the two disagree about contact. missed : the longest run of such frames. late : frames in which some
    number is stale, further from the fresh one than noise takes it. stale : the longest run of such frames.
    worst, rms, values : number -> difference over the repeated frames, and how many. noise : number -> its
    noise; where hardly three repeated frames follow each other it comes from all frames. times : "on" and
    "off" -> times of a frame.
    """

    scene: str
    frames: int = 0
    repeated: int = 0
    rest: int = 0
    decisions: int = 0
    missed: int = 0
    late: int = 0
    stale: int = 0
    worst: dict[str, float] = field(default_factory=dict[str, float])
    rms: dict[str, float] = field(default_factory=dict[str, float])
    values: dict[str, int] = field(default_factory=dict[str, int])
    noise: dict[str, Noise] = field(default_factory=dict[str, Noise])
    times: dict[str, Samples] = field(default_factory=lambda: {"on": Samples(), "off": Samples()})

    @property
    def faults(self) -> list[str]:
        """What skipping changed beyond noise; empty if nothing."""
        found = [f"{self.decisions} contact decisions differ"] if self.decisions else []
        for name, rms in self.rms.items():
            enough = self.values[name] >= ENOUGH
            if enough and name in self.noise and rms > ALLOWED * self.noise[name].rms:
                found.append(f"{name}: RMS difference {rms:.3g} with a noise of {self.noise[name].rms:.3g}")
        if self.stale > STALE:
            found.append(f"a number is stale for {self.stale} frames")
        return found


def compare(pipeline: Pipeline, source: str | Path, scene: str, scratch: Path) -> Comparison:
    """Run a pipeline on a recording with and without skipping.

    pipeline : as loaded. source : what its capture stage shall open. scene : name in the result.
    scratch : folder for the JSON lines.
    """
    on = on_recording(replace(pipeline, skipping=True), Path(source))
    runs = {
        "on": LockstepPipeline(on, scratch / "on.jsonl"),
        "off": LockstepPipeline(replace(on, skipping=False), scratch / "off.jsonl"),
    }
    result = Comparison(scene)
    rows: list[_Row] = []
    last: Outcome | None = None
    try:
        with quiet():
            while True:
                order = ("on", "off") if result.frames % 2 else ("off", "on")
                outcomes = {name: runs[name].step() for name in order}
                mine, fresh = outcomes["on"], outcomes["off"]
                if mine is None or fresh is None:
                    break
                if mine.frame.seq < 0:  # the reference, handed over in front of the recording
                    continue
                repeated = last is not None and mine.image is last.image
                last = mine
                for name, outcome in (("on", mine), ("off", fresh)):
                    result.times[name].add(outcome.cpu, outcome.wall)
                differs = (mine.contact is None) != (fresh.contact is None)
                result.frames += 1
                rows.append(_Row(repeated, _numbers(mine), _numbers(fresh), differs))
    finally:
        for run in runs.values():
            run.close()
    _judge(result, rows)
    return result


@dataclass(frozen=True, slots=True)
class _Row:
    """One frame: whether its result was repeated, the numbers with and without skipping, and whether the two
    disagree about contact."""

    repeated: bool
    on: Mapping[str, NDArray[np.float64]]
    off: Mapping[str, NDArray[np.float64]]
    differs: bool = False

    def difference(self, name: str) -> NDArray[np.float64] | None:
        """What a number differs by, or None where one of the two does not have it."""
        on, off = self.on.get(name), self.off.get(name)
        if on is None or off is None or on.size != off.size:
            return None
        return _difference(name, on, off)


def _numbers(outcome: Outcome) -> dict[str, NDArray[np.float64]]:
    """The published numbers of a frame. The area is a logarithm in %, so that differences are relative."""
    numbers: dict[str, NDArray[np.float64]] = {}
    if outcome.markers is not None:
        numbers["marker"] = outcome.markers.position.ravel()
    if outcome.contact is not None:
        numbers["center"] = np.array(outcome.contact.center)
        numbers["area"] = np.array([100 * math.log(max(outcome.contact.area, 1.0))])
        if outcome.contact.angle is not None:
            numbers["angle"] = np.array([outcome.contact.angle])
    if outcome.flow is not None and outcome.flow.mean is not None:
        numbers["flow"] = np.array(outcome.flow.mean)
    return numbers


def _difference(name: str, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """a - b; angles across the seam at +-90 degrees."""
    difference: NDArray[np.float64] = a - b
    return (difference + 90) % 180 - 90 if name == "angle" else difference


def _judge(result: Comparison, rows: Sequence[_Row]) -> None:
    result.repeated = sum(row.repeated for row in rows)
    result.rest = _longest(row.repeated for row in rows)
    result.decisions = sum(row.differs for row in rows)
    result.missed = _longest(row.differs for row in rows)
    stale = np.zeros(len(rows), np.bool_)
    for name in NUMBERS:
        noise = _noise_of(name, rows)
        if noise is not None:
            result.noise[name] = noise
        differences = {
            index: difference
            for index, row in enumerate(rows)
            if row.repeated and (difference := row.difference(name)) is not None and difference.size
        }
        if not differences:
            continue
        joined = np.concatenate(list(differences.values()))
        result.values[name] = joined.size
        result.worst[name] = float(np.abs(joined).max())
        result.rms[name] = float(np.sqrt(np.square(joined).mean()))
        if noise is not None:
            for index, difference in differences.items():
                stale[index] |= np.abs(difference).max() > LARGEST * noise.largest
    result.late = int(np.count_nonzero(stale))
    result.stale = _longest(stale)


def _noise_of(name: str, rows: Sequence[_Row]) -> Noise | None:
    """A number's noise, without skipping: from what was repeated, or if that is too rare, from all frames."""
    resting: list[NDArray[np.float64]] = []
    always: list[NDArray[np.float64]] = []
    for before, now, after in zip(rows, rows[1:], rows[2:], strict=False):
        first, second, third = (row.off.get(name, np.empty(0)) for row in (before, now, after))
        if first.size == second.size == third.size > 0:
            bend = _difference(name, first, second) - _difference(name, second, third)
            always.append(bend)
            if before.repeated and now.repeated and after.repeated:
                resting.append(bend)
    bends = resting if sum(bend.size for bend in resting) >= ENOUGH else always
    joined = np.concatenate([np.empty(0), *bends])
    if joined.size < ENOUGH:
        return None
    rms = float(np.sqrt(np.square(joined).mean()))
    peaks = np.sort([np.abs(bend).max() for bend in bends])
    if bends is always:
        # Most frames move little: their median is hardly that of motion.
        rms = float(np.median(np.abs(joined))) / _MEDIAN_DEVIATION
        peaks = np.append(0, peaks[peaks < _OUTLIER * rms])
    # A jump that was not noticed is in three of them and must not excuse itself.
    largest = float(peaks[-1 - min(3, len(peaks) // 20)])
    return Noise(rms / _SECOND_DIFFERENCE, largest / _LARGEST_BEND)


def _longest(flags: Iterable[bool]) -> int:
    """The longest run of true values."""
    longest = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest


@dataclass(frozen=True, slots=True)
class Pipelines:
    """What to compare: on gels with markers, on gels without, and on recordings of the wedge sensor."""

    default: Pipeline
    markerless: Pipeline
    wedge: Pipeline


def compare_all(
    pipelines: Pipelines,
    frames: int,
    data: Path | None,
    copies: CopyUnit,
    progress: Callable[[str, int, int], None],
) -> Iterator[Comparison]:
    """Compare on the simulated scenes of `SCENES` and `ADVERSARIES`, and on the recordings in `data`.

    frames : length of each scene. copies : measures the unit of time along the way.
    progress : called with a name, the number done, and the number in all.
    """
    real = [] if data is None else _recordings(pipelines, data)
    scenes = tuple(dict.fromkeys((*SCENES, *ADVERSARIES)))
    count = len(scenes) + len(real)
    for index, spec in enumerate(scenes):
        progress(spec, index, count)
        copies.take(5)
        with tempfile.TemporaryDirectory() as folder:
            scratch = Path(folder)
            path = scratch / "scene.npy"
            scene = open_scene(spec + ("&" if "?" in spec else "?") + f"frames={frames}")
            write_frames(scene, path)
            pipeline = pipelines.default if len(scene.layout.rest) else pipelines.markerless
            yield compare(pipeline, path, spec, scratch)
    for index, (name, pipeline, path) in enumerate(real, len(scenes)):
        progress(name, index, count)
        copies.take(5)
        with tempfile.TemporaryDirectory() as folder:
            yield compare(pipeline, path, name, Path(folder))


def _recordings(pipelines: Pipelines, data: Path) -> list[tuple[str, Pipeline, Path]]:
    """Name, pipeline and source of each recording; the single presses count as one, in a row."""
    found = [(name, pipelines.wedge, data / name) for name in ("wedge_roll", "wedge_ball")]
    found += [(f.stem, pipelines.markerless, f) for f in sorted((data / "wedge_grasp").glob("*.avi"))]
    return [item for item in found if item[2].exists()]
