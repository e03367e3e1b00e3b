"""Whole pipelines on simulated scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

from tactflow.bench import metrics
from tactflow.bench.lockstep import LockstepPipeline, TimedResult, on_recording, take_turns
from tactflow.bench.pictures import WorstFrame
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


def measure_pipelines(
    result: BenchResult,
    pipelines: Mapping[str, Pipeline],
    rendered: Rendered,
    unit: CopyUnit,
    step: Callable[[int], None],
    pictures: Path | None = None,
) -> None:
    """Measure every pipeline on one scene, in turns of a few frames.

    Parameters
    ----------
    result : what is measured is added to it. pipelines : name -> pipeline. rendered : the scene.
    unit : measured along the way. step : called with the number of frames that all have done.
    pictures : folder for the frame of at least half depth on which each pipeline was worst, or None.
    """
    scene = rendered.case.label
    scores = {name: PipelineScore(rendered, Tally()) for name in pipelines}
    worst = {name: WorstFrame() for name in pipelines}

    def see(name: str, found: TimedResult) -> str:
        truth = scores[name].truth(found)
        if pictures is not None and truth.touching and rendered.deep(found.frame.seq):
            overlap = metrics.convex_iou(found.contact.hull, truth.hull) if found.contact else 0.0
            worst[name].see(overlap, found, truth.contact_mask, truth.center)
        return scores[name].add(found)

    ready = {name: on_recording(pipeline, rendered.path) for name, pipeline in pipelines.items()}
    times, failures = take_turns(ready, see, unit=unit, step=step)
    for name in pipelines:
        if name in failures:
            result.failures[f"{PIPELINE}/{name}/{scene}"] = failures[name]
        else:
            errors = scores[name].tally.errors()
            result.add(PIPELINE, name, scene, errors, times=times[name], frames=len(rendered))
            worst[name].write(pictures, f"{scene}-{name}")


def measure_refusal(result: BenchResult, name: str, pipeline: Pipeline, scene: str) -> None:
    """Measure what a pipeline for markers takes for markers on a gel without: at best, it refuses to run.

    result : the number of false markers is added to it. name : of the pipeline. pipeline : with a recording
    of such a gel. scene : its name in the result.
    """
    false_markers = 0
    try:
        with quiet(), closing(LockstepPipeline(pipeline)) as running:
            for found in running.block(1):
                false_markers = 0 if found.markers is None else len(found.markers.position)
    except TactflowError as error:
        if NoMarkersError.__name__ not in str(error):
            result.failures[f"{PIPELINE}/{name}/{scene}"] = str(error)
            return
    result.add(PIPELINE, name, scene, {"markers_false": float(false_markers)}, frames=1)
