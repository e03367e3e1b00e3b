"""What skipping costs and saves: a pipeline with it against the same pipeline without it, frame by frame.

Two runs of one pipeline take turns on the same frames; one has `skipping: false`. Wherever the skipping one
repeats a result, the other one has measured afresh, so the two numbers differ by the noise of two
measurements and by whatever moved in between without being noticed. Beside each difference stands the
number's own noise, taken from the run without skipping: the second difference of three frames in a row,
whose deviation is sqrt(6) times that of one frame and in which slow motion cancels.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.pipelines import on_recording
from tactflow.bench.timing import CopyUnit, Samples, quiet
from tactflow.engine.graph import Pipeline
from tactflow.sim import open_scene
from tactflow.sim.export import write_frames

NUMBERS = {"marker": "px", "center": "px", "area": "%", "angle": "deg", "flow": "px"}
"""The published numbers that are compared, and their units."""

SCENES = (
    *("idle", "hold", "press", "cable", "slide", "twist", "two", "border", "worn", "unmarked"),
    *("bright", "noisy", "creep", "drift", "flicker", "tap", "spike", "stutter", "jumps", "dense"),
)

ALLOWED = 3.0
"""The RMS difference a repeated number may have, in standard deviations of the number itself: sqrt(2) is the
noise of two measurements, the rest is for what moved too little to be noticed."""

_SECOND_DIFFERENCE = math.sqrt(6)
_ENOUGH = 20
"""Second differences from which a noise is told: it is then known to about a fifth."""


@dataclass(slots=True)
class Comparison:
    """One scene with and without skipping.

    repeated : frames whose result was repeated. decisions : frames in which the two disagree about contact.
    longest : the longest run of such frames. worst, rms : number -> difference over the repeated frames.
    noise : number -> standard deviation of one measurement, or absent where no three repeated frames follow
    each other. times : "on" and "off" -> times of a frame.
    """

    scene: str
    frames: int = 0
    repeated: int = 0
    decisions: int = 0
    longest: int = 0
    worst: dict[str, float] = field(default_factory=dict[str, float])
    rms: dict[str, float] = field(default_factory=dict[str, float])
    noise: dict[str, float] = field(default_factory=dict[str, float])
    times: dict[str, Samples] = field(default_factory=lambda: {"on": Samples(), "off": Samples()})

    @property
    def faults(self) -> list[str]:
        """What skipping changed beyond noise; empty if nothing."""
        found = [f"{self.decisions} contact decisions differ"] if self.decisions else []
        for name, rms in self.rms.items():
            if name in self.noise and rms > ALLOWED * self.noise[name]:
                found.append(f"{name}: RMS difference {rms:.3g} with a noise of {self.noise[name]:.3g}")
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
    disagree = 0
    last: Outcome | None = None
    try:
        with quiet():
            while True:
                order = ("on", "off") if result.frames % 2 else ("off", "on")
                outcomes = {name: runs[name].step() for name in order}
                mine, fresh = outcomes["on"], outcomes["off"]
                if mine is None or fresh is None:
                    break
                repeated = last is not None and mine.image is last.image
                last = mine
                for name, outcome in (("on", mine), ("off", fresh)):
                    result.times[name].add(outcome.cpu, outcome.wall)
                differs = (mine.contact is None) != (fresh.contact is None)
                disagree = disagree + 1 if differs else 0
                result.decisions += differs
                result.longest = max(result.longest, disagree)
                result.repeated += repeated
                result.frames += 1
                rows.append(_Row(repeated, _numbers(mine), _numbers(fresh)))
    finally:
        for run in runs.values():
            run.close()
    _judge(result, rows)
    return result


@dataclass(frozen=True, slots=True)
class _Row:
    """One frame: whether its result was repeated, and the numbers with and without skipping."""

    repeated: bool
    on: Mapping[str, NDArray[np.float64]]
    off: Mapping[str, NDArray[np.float64]]


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
    for name in NUMBERS:
        differences = [
            _difference(name, row.on[name], row.off[name])
            for row in rows
            if row.repeated and name in row.on and name in row.off and row.on[name].size == row.off[name].size
        ]
        if differences:
            joined = np.concatenate(differences)
            result.worst[name] = float(np.abs(joined).max())
            result.rms[name] = float(np.sqrt(np.square(joined).mean()))
        bends = [
            _difference(name, before.off[name], now.off[name])
            - _difference(name, now.off[name], after.off[name])
            for before, now, after in zip(rows, rows[1:], rows[2:], strict=False)
            if before.repeated and now.repeated and after.repeated
            if all(name in row.off for row in (before, now, after))
        ]
        joined = np.concatenate(bends) if bends else np.empty(0)
        if joined.size >= _ENOUGH:
            result.noise[name] = float(np.sqrt(np.square(joined).mean())) / _SECOND_DIFFERENCE


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
    """Compare on every simulated scene of `SCENES`, and on the recordings in `data`.

    frames : length of each scene. copies : measures the unit of time along the way.
    progress : called with a name, the number done, and the number in all.
    """
    real = [] if data is None else _recordings(pipelines, data)
    count = len(SCENES) + len(real)
    for index, spec in enumerate(SCENES):
        progress(spec, index, count)
        copies.take(5)
        with tempfile.TemporaryDirectory() as folder:
            scratch = Path(folder)
            path = scratch / "scene.npy"
            write_frames(open_scene(spec + ("&" if "?" in spec else "?") + f"frames={frames}"), path)
            pipeline = pipelines.markerless if spec == "unmarked" else pipelines.default
            yield compare(pipeline, path, spec, scratch)
    for index, (name, pipeline, path) in enumerate(real, len(SCENES)):
        progress(name, index, count)
        copies.take(5)
        with tempfile.TemporaryDirectory() as folder:
            yield compare(pipeline, path, name, Path(folder))


def _recordings(pipelines: Pipelines, data: Path) -> list[tuple[str, Pipeline, Path]]:
    """Name, pipeline and source of each recording; the single presses count as one, in a row."""
    found = [(name, pipelines.wedge, data / name) for name in ("wedge_roll", "wedge_ball")]
    found += [(f.stem, pipelines.markerless, f) for f in sorted((data / "wedge_grasp").glob("*.avi"))]
    return [item for item in found if item[2].exists()]


def print_comparisons(comparisons: Sequence[Comparison], copies: CopyUnit, console: Console) -> None:
    """Two tables: what skipping changed, and what it saved."""
    changed = Table(
        title="skipping on against off: RMS difference of what was repeated / largest / noise of one result",
        title_justify="left",
        title_style="bold",
    )
    changed.add_column("scene")
    for heading in ("frames", "repeated", "decisions differ", "longest"):
        changed.add_column(heading, justify="right")
    for name, unit in NUMBERS.items():
        changed.add_column(f"{name}, {unit}", justify="right")
    changed.add_column("beyond noise")
    for one in comparisons:
        cells = [one.scene, str(one.frames), f"{100 * one.repeated / max(one.frames, 1):.0f} %"]
        cells += [str(one.decisions), str(one.longest)]
        for name in NUMBERS:
            if name not in one.rms:
                cells.append("-")
                continue
            noise = f"{one.noise[name]:.2g}" if name in one.noise else "-"
            cells.append(f"{one.rms[name]:.2g} / {one.worst[name]:.2g} / {noise}")
        changed.add_row(*cells, "; ".join(one.faults) or "nothing")
    changed.caption = f"beyond noise: RMS above {ALLOWED:g} x noise, or a contact decision that differs"
    changed.caption_justify = "left"
    console.print(changed)

    saved = Table(title="median CPU time of a frame, copies of the raw frame", title_justify="left")
    for heading in ("scene", "on", "off", "on / off"):
        saved.add_column(heading, justify="left" if heading == "scene" else "right")
    for one in comparisons:
        on, off = (one.times[name].summary()["cpu_ms_p50"] for name in ("on", "off"))
        saved.add_row(
            one.scene, f"{on / copies.copy_ms:.1f}", f"{off / copies.copy_ms:.1f}", f"{on / off:.2f}"
        )
    console.print(saved)
