"""Whole pipelines on simulated scenes, compared with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from tactflow.bench.lockstep import LockstepPipeline, on_recording, take_turns
from tactflow.bench.quantities import Tally
from tactflow.bench.results import BenchResult
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import PipelineScore
from tactflow.bench.timing import CopyUnit, quiet
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.vision.markers.detection import NoMarkersError

PIPELINE = "pipeline"
"""Group of the rows about whole pipelines."""

CLASSIC = "classic"
"""Name of the pipeline that is the yardstick: the original script."""


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

    def measure(self, pipelines: Mapping[str, Pipeline], rendered: Rendered) -> None:
        """Run pipelines, in turns of a few frames, on a scene.

        pipelines : name -> pipeline.
        """
        scene = rendered.case.label
        scores = {name: PipelineScore(rendered, Tally()) for name in pipelines}
        ready = {name: on_recording(pipeline, rendered.path) for name, pipeline in pipelines.items()}
        times, failures = take_turns(ready, lambda name, found: scores[name].add(found), unit=self.unit)
        for name, score in scores.items():
            if self.pictures is not None:
                score.worst.write(self.pictures, f"{scene}-{name}")
            if name in failures:
                self.result.failures[f"{PIPELINE}/{name}/{scene}"] = failures[name]
            else:
                errors, frames = score.tally.errors(), sum(map(len, times[name].values()))
                self.result.add(PIPELINE, name, scene, errors, times=times[name], frames=frames)

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
