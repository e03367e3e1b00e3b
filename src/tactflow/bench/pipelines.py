"""Whole pipelines on simulated scenes and on recordings, compared with what is known of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from tactflow.bench.lockstep import LockstepPipeline, TimedResult, on_recording, take_turns
from tactflow.bench.pictures import WorstFrame
from tactflow.bench.quantities import Tally
from tactflow.bench.results import RECORDING, BenchResult
from tactflow.bench.timing import CopyUnit, Times, quiet
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.vision.markers.detection import NoMarkersError

PIPELINE = "pipeline"
"""Group of the rows about whole pipelines."""

CLASSIC = "classic"
"""Name of the pipeline that is the yardstick: the original script."""


class Judge:
    """Compares what one pipeline finds in one recording with what is known of it.

    tally : gets the errors. frames : how many were judged. worst : on which frame the pipeline was worst.
    """

    def __init__(self, tally: Tally) -> None:
        self.tally = tally
        self.frames = 0
        self.worst = WorstFrame()

    def add(self, result: TimedResult) -> str:
        """Compare one frame; returns the kind of frame: "contact" or "idle"."""
        raise NotImplementedError

    def finish(self) -> None:
        """Compare what can be compared only when the recording is over."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What all measurements share.

    result : rows are added to it. unit : measured along the way. scratch : folder for temporary files.
    pictures : folder for pictures of worst frames, or None.
    """

    result: BenchResult
    unit: CopyUnit
    scratch: Path
    pictures: Path | None = None

    def measure(
        self,
        pipelines: Mapping[str, Pipeline],
        scene: str,
        parts: Sequence[tuple[Path, Callable[[Tally], Judge]]],
    ) -> None:
        """Run pipelines, in turns of a few frames, on a scene or on the parts of a recording.

        Parameters
        ----------
        pipelines : name -> pipeline. scene : name of the scene or recording in the result.
        parts : recordings, each with a function that makes a judge for one pipeline.
        """
        tallies = {name: Tally() for name in pipelines}
        times: dict[str, Times] = {name: defaultdict(list) for name in pipelines}
        frames, failures = dict.fromkeys(pipelines, 0), dict[str, str]()
        for path, make_judge in parts:
            judges = {name: make_judge(tally) for name, tally in tallies.items()}

            def see(name: str, found: TimedResult, judges: Mapping[str, Judge] = judges) -> str:
                judges[name].frames += 1
                return judges[name].add(found)

            ready = {name: on_recording(pipeline, path) for name, pipeline in pipelines.items()}
            measured, failed = take_turns(ready, see, unit=self.unit)
            failures.update(failed)
            for name, judge in judges.items():
                judge.finish()
                frames[name] += judge.frames
                for kind, samples in measured[name].items():
                    times[name][kind] += samples
                if self.pictures is not None:
                    part = f"{scene}-{path.stem}" if len(parts) > 1 else scene
                    judge.worst.write(self.pictures, f"{part.removeprefix(RECORDING)}-{name}")
        for name, tally in tallies.items():
            if name in failures:
                self.result.failures[f"{PIPELINE}/{name}/{scene}"] = failures[name]
            else:
                errors = tally.errors()
                self.result.add(PIPELINE, name, scene, errors, times=times[name], frames=frames[name])

    def measure_refusal(self, name: str, pipeline: Pipeline, scene: str) -> None:
        """Measure what a pipeline for markers takes for markers on a gel without: at best, it refuses to run.

        name : of the pipeline. pipeline : with a recording of such a gel. scene : its name in the result.
        """
        false_markers = 0
        try:
            with quiet(), closing(LockstepPipeline(pipeline)) as running:
                for found in running.block(1):
                    false_markers = 0 if found.markers is None else len(found.markers.position)
        except TactflowError as error:
            if NoMarkersError.__name__ not in str(error):
                self.result.failures[f"{PIPELINE}/{name}/{scene}"] = str(error)
                return
        self.result.add(PIPELINE, name, scene, {"markers_false": float(false_markers)}, frames=1)
