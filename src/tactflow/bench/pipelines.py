"""Whole pipelines on simulated scenes, compared with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tactflow.bench.lockstep import on_recording, take_turns
from tactflow.bench.quantities import Tally
from tactflow.bench.results import BenchResult
from tactflow.bench.scenes import Rendered
from tactflow.bench.score import PipelineScore
from tactflow.bench.timing import CopyUnit
from tactflow.engine.graph import Pipeline

PIPELINE = "pipeline"
"""Group of the rows about whole pipelines."""

CLASSIC = "classic"
"""Name of the pipeline that is the yardstick: the original script."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What all measurements share.

    result : rows are added to it. unit : measured along the way. scratch : folder for temporary files.
    """

    result: BenchResult
    unit: CopyUnit
    scratch: Path

    def measure(self, pipelines: Mapping[str, Pipeline], rendered: Rendered) -> None:
        """Run pipelines, in turns of a few frames, on a scene.

        pipelines : name -> pipeline.
        """
        scene = rendered.case.label
        scores = {name: PipelineScore(rendered, Tally()) for name in pipelines}
        ready = {name: on_recording(pipeline, rendered.path) for name, pipeline in pipelines.items()}
        times, failures = take_turns(ready, lambda name, found: scores[name].add(found), unit=self.unit)
        for name, score in scores.items():
            if name in failures:
                self.result.failures[f"{PIPELINE}/{name}/{scene}"] = failures[name]
            else:
                errors, frames = score.tally.errors(), sum(map(len, times[name].values()))
                self.result.add(PIPELINE, name, scene, errors, times=times[name], frames=frames)
