"""Whole pipelines end to end: from the file on disk to the JSON line."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.methods import CLASSIC, fill_times
from tactflow.bench.results import Measurement
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import ContactScore, FlowScore, MarkerScore
from tactflow.bench.timing import BLOCK, CopyUnit, Samples, quiet, timed
from tactflow.classic.functions import contact_mask, difference, inpaint, mask_marker
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.sim import Truth
from tactflow.system.children import python_command
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.markers.detection import NoMarkersError


def on_recording(pipeline: Pipeline, path: Path, **params: Any) -> Pipeline:
    """The same pipeline reading another recording.

    Parameters
    ----------
    path : the recording. params : further parameters of the capture stage.
    """
    source = pipeline.source
    changed = source.component.params.model_validate(
        {**source.params.model_dump(exclude_unset=True), "source": str(path), **params}
    )
    return replace(pipeline, nodes={**pipeline.nodes, source.id: replace(source, params=changed)})


@dataclass(slots=True)
class Worst:
    """The frame on which a pipeline was worst, by the overlap of the hulls, in frames of at least half depth.

    overlap : 0 to 1, or 2 before anything was seen. outcome, truth : of that frame.
    """

    overlap: float = 2.0
    outcome: Outcome | None = None
    truth: Truth | None = None

    def see(self, outcome: Outcome, truth: Truth) -> None:
        """Keep this frame if it is worse."""
        overlap = metrics.convex_iou(outcome.contact.hull, truth.hull) if outcome.contact else 0.0
        if overlap < self.overlap:
            self.overlap, self.outcome, self.truth = overlap, outcome, truth


@dataclass(slots=True)
class PipelineScore:
    """What a pipeline said about a scene, against the truth; `worst` keeps its worst frame, if given."""

    contact: ContactScore = field(default_factory=ContactScore)
    markers: MarkerScore = field(default_factory=MarkerScore)
    flow: FlowScore = field(default_factory=FlowScore)
    limit: float | None = None
    worst: Worst | None = None

    def add(self, outcome: Outcome, rendered: Rendered) -> str:
        """Judge one frame; returns whether it shows a contact, as a kind of time."""
        index = outcome.frame.seq
        if index < 0:  # the reference, handed over in front of the recording
            return "reference"
        mapping = outcome.mapping
        if mapping is None:
            height, width = outcome.frame.image.shape[:2]
            mapping = PixelMapping.identity((width, height))
        truth = rendered.truths(mapping)[index]
        deep = rendered.deep(index)
        if self.worst is not None and deep and truth.touching:
            self.worst.see(outcome, truth)
        if self.contact.detected(outcome.contact is not None, truth, deep):
            assert outcome.contact is not None
            self.contact.geometry(outcome.contact, truth)
            if outcome.contact_mask is not None:
                self.contact.mask(outcome.contact_mask, truth)
        if outcome.markers is not None:
            self.markers.add(outcome.markers, truth)
            self.limit = self.limit or rendered.displacement_limit(mapping)
        self.flow.add(outcome.flow, truth)
        return "contact" if truth.touching else "idle"

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        return {**self.contact.errors(), **self.markers.errors(), **self.flow.errors()}


@dataclass(slots=True)
class Times:
    """samples : pipeline -> kind of frame -> samples. stages : pipeline -> stage -> median of a call, ms."""

    samples: dict[str, dict[Any, Samples]]
    stages: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])


ORIGINAL = "original script"
"""The yardstick plus what the script repeats in every frame without need."""

_REPEATS_EVERY = 5
"""Frames from one to the next on which the repeats are timed: one takes as long as the rest of the script."""


class OriginalRepeats:
    """Times what the original script does in every frame and the classic pipeline does not.

    The script removes the markers from the reference again for every frame, computes the marker mask a third
    time to find the markers' centres, and works out the difference in floating point. None of that changes a
    result, so the classic pipeline leaves it out; for the time of the script it counts.
    """

    def __init__(self) -> None:
        self._reference: NDArray[np.uint8] | None = None
        self._unmarked: NDArray[np.uint8] | None = None
        self.samples: dict[str, Samples] = {}

    def measure(self, image: NDArray[np.uint8], kind: str) -> None:
        """Time it for one processed frame; the first one is the reference."""
        if self._reference is None or self._unmarked is None:
            self._reference = image.copy()
            self._unmarked = inpaint(image)
            return
        unmarked = self._unmarked
        integer = Samples()
        timed(lambda: contact_mask(image, unmarked), integer)
        samples = self.samples.setdefault(kind, Samples())
        timed(lambda: self._repeat(image), samples)
        samples.cpu[-1] -= integer.cpu[-1]
        samples.wall[-1] -= integer.wall[-1]

    def _repeat(self, image: NDArray[np.uint8]) -> None:
        assert self._reference is not None
        assert self._unmarked is not None
        inpaint(self._reference)
        mask_marker(image)
        difference(image, self._unmarked)


def _original(classic: Measurement, repeats: OriginalRepeats, unit: CopyUnit) -> Measurement:
    """The script's time: that of the classic pipeline and of the repeats; its answers are the same."""
    made = replace(classic, method=ORIGINAL, time={}, copies={}, faster={}, stages_ms={}, peak_mb=None)
    for kind, samples in repeats.samples.items():
        extra, own = samples.summary(), classic.time.get(kind, {})
        if not own:
            continue
        made.time[kind] = {name: own[name] + extra[name] for name in own if name != "count"}
        made.time[kind]["count"] = extra["count"]
        made.copies[kind] = made.time[kind]["cpu_ms_p50"] / unit.copy_ms
        made.faster[kind] = own["cpu_ms_p50"] / made.time[kind]["cpu_ms_p50"]
    return made


def take_turns(
    pipelines: Mapping[str, Pipeline],
    folder: Path,
    unit: CopyUnit,
    see: Callable[[str, Outcome], str],
    step: Callable[[], None],
    block: int = BLOCK,
    late: Callable[[], bool] = lambda: False,
) -> tuple[Times, dict[str, str]]:
    """Run pipelines in turns of a few frames until all recordings are over.

    Parameters
    ----------
    pipelines : name -> pipeline, each with its recording.
    folder : for the JSON lines. late : asked when all have had a turn; if it is, that was the last one.
    see : called with (name, outcome) for each frame, after its turn; returns the kind of frame its time
        belongs to. step : called once per frame, when all have done it. block : frames in a turn.

    Returns
    -------
    times, and failures : name -> why it stopped.
    """
    times = Times({name: {} for name in pipelines})
    failures: dict[str, str] = {}
    running: dict[str, LockstepPipeline] = {}
    with quiet():
        try:
            for name, pipeline in pipelines.items():
                try:
                    running[name] = LockstepPipeline(pipeline, folder / f"{name}.jsonl")
                except TactflowError as error:
                    failures[name] = str(error)
            active = list(running)
            while active:
                unit.take(block)
                longest = 0
                for name in list(active):
                    try:
                        outcomes = running[name].block(block)
                    except TactflowError as error:
                        failures[name] = str(error)
                        active.remove(name)
                        continue
                    if not outcomes:
                        active.remove(name)
                    longest = max(longest, len(outcomes))
                    for outcome in outcomes:
                        kind = see(name, outcome)
                        if outcome.frame.reference:
                            kind = "reference"
                        times.samples[name].setdefault(kind, Samples()).add(outcome.cpu, outcome.wall)
                for _ in range(longest):
                    step()
                if late():
                    break
            times.stages = {name: lockstep.stages_ms() for name, lockstep in running.items()}
        finally:
            for lockstep in running.values():
                lockstep.close()
    return times, failures


def measure_pipelines(
    pipelines: Mapping[str, Pipeline],
    rendered: Rendered,
    folder: Path,
    unit: CopyUnit,
    step: Callable[[], None],
    worst: Callable[[str, Worst], None] = lambda *_: None,
) -> list[Measurement]:
    """Every pipeline on one scene, in turns of a few frames.

    Parameters
    ----------
    pipelines : name -> pipeline; `CLASSIC` is the yardstick.
    rendered : the scene. folder : for scratch files.
    step : called after each frame. worst : called with each pipeline's name and worst frame.
    """
    scores = {name: PipelineScore(worst=Worst()) for name in pipelines}
    repeats = OriginalRepeats()

    def see(name: str, outcome: Outcome) -> str:
        kind = scores[name].add(outcome, rendered)
        if name == CLASSIC and outcome.image is not None and outcome.frame.seq % _REPEATS_EVERY == 0:
            repeats.measure(outcome.image, kind)
        return kind

    ready = {name: on_recording(pipeline, rendered.path) for name, pipeline in pipelines.items()}
    times, failures = take_turns(ready, folder, unit, see, step)
    made = []
    for name in pipelines:
        measurement = Measurement("pipeline", name, rendered.case.label, frames=len(rendered))
        measurement.failure = failures.get(name)
        if measurement.failure is None:
            measurement.errors = scores[name].errors()
            worst(name, scores[name].worst or Worst())
            limit = scores[name].limit
            if limit is not None:
                measurement.limits["displacement_rms"] = limit
            fill_times(measurement, times.samples[name], unit, times.samples.get(CLASSIC))
            measurement.stages_ms = times.stages.get(name, {})
        made.append(measurement)
        if name == CLASSIC and repeats.samples and measurement.failure is None:
            made.append(_original(measurement, repeats, unit))
    return made


def measure_refusal(name: str, pipeline: Pipeline, scene: str, folder: Path) -> Measurement:
    """What a pipeline for markers takes for markers on a gel that has none: at best, it refuses to run.

    name : of the pipeline. pipeline : with a recording of such a gel. scene : what results call it.
    folder : for scratch files.
    """
    made = Measurement("pipeline", name, scene, frames=1, errors={"markers_false": 0.0})
    with quiet():
        running = LockstepPipeline(pipeline, folder / f"{name}.jsonl")
        try:
            outcome = running.step()
            if outcome is not None and outcome.markers is not None:
                made.errors["markers_false"] = float(len(outcome.markers.position))
        except TactflowError as error:
            if NoMarkersError.__name__ not in str(error):
                made.errors, made.failure = {}, str(error)
        finally:
            running.close()
    return made


def growth(pipeline: Pipeline, rendered: Rendered, folder: Path, unit: CopyUnit) -> float | None:
    """How many times as long a frame with contact takes with 4 times the pixels and 4 times the markers.

    The large recording shows every frame of the small one four times, mirrored at the seams, so that pixels,
    markers and contact area all grow by four and the dots keep their size.
    """
    path = folder / "large.npy"
    small = rendered.frames
    shape = (len(small), 2 * small.shape[1], 2 * small.shape[2], 3)
    large = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
    for index, frame in enumerate(small):
        upper = np.concatenate([frame, frame[:, ::-1]], axis=1)
        large[index] = np.concatenate([upper, upper[::-1]], axis=0)
    large.flush()
    ready = {"small": on_recording(pipeline, rendered.path), "large": on_recording(pipeline, path)}
    try:
        times, failures = take_turns(
            ready,
            folder,
            unit,
            lambda _, outcome: _depth_kind(outcome, rendered),
            lambda: None,
        )
    finally:
        path.unlink(missing_ok=True)
    if failures:
        return None
    large_ms, small_ms = (times.samples[n]["contact"].summary()["cpu_ms_p50"] for n in ("large", "small"))
    return large_ms / small_ms


def _depth_kind(outcome: Outcome, rendered: Rendered) -> str:
    """Whether a frame's time belongs to contact or not; the reference in front of a recording is neither."""
    if outcome.frame.seq < 0:
        return "reference"
    return "contact" if rendered.deep(outcome.frame.seq) else "idle"


_MEASURE_MEMORY = """
import sys
from tactflow.cli.main import main
code = main(sys.argv[1:])
try:
    # What getrusage reports survives exec: it would be the memory of the process that started this one.
    with open("/proc/self/status") as status:
        print(next(line.split()[1] for line in status if line.startswith("VmHWM")))
except OSError:
    import resource
    # Not Linux; macOS counts in bytes.
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // (1000 if sys.platform == "darwin" else 1))
sys.exit(code)
"""


def peak_memory_mb(file: Path, recording: Path, sinks: Sequence[str]) -> float | None:
    """Peak memory of `tactflow run` on a recording, MB, or None where it failed.

    It includes what the system maps of the recording itself, so a short one is to be used.

    Parameters
    ----------
    file : the pipeline's file. recording : what it reads. sinks : ids of its sinks, which are left out.
    """
    command = python_command("-c", _MEASURE_MEMORY, "run", str(file), "--source", str(recording))
    command += ["--quiet", "--jsonl", os.devnull]
    for sink in sinks:
        command += ["--set", f"sinks.{sink}=null"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    words = done.stdout.split()
    return int(words[-1]) / 1e3 if done.returncode == 0 and words else None
