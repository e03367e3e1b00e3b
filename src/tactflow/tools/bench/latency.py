"""From capture to message: how old a result is when it is ready, at a camera's pace, in a real run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

import numpy as np

from tactflow.api import make_runner
from tactflow.engine.collect import with_collector
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.message.result import Result, encode_message
from tactflow.tools.bench.lockstep import with_params

WARM_UP_FRAMES: Final = 30
"""First frames that are not counted: they hold the reference."""


def measure_latency(pipeline: Pipeline, recording: Path, fps: float = 60.0) -> list[float]:
    """Ages of the results of a live run, ms, in the order of the frames.

    The run has its threads and queues as in use, and the garbage collector is on; the age is that of the
    encoded message.

    recording : played at its own pace. fps : of a recording that does not say.

    Raises TactflowError if the pipeline fails.
    """
    ages: list[float] = []

    def take(result: Result) -> None:
        encode_message(result)
        if result.seq >= WARM_UP_FRAMES:
            ages.append(1e3 * (time.perf_counter() - result.frame.captured))

    source = pipeline.source.params.changed(source=str(recording), realtime=True, fps=fps)
    live = with_params(pipeline, pipeline.source.id, source)
    done = make_runner(with_collector(live, Result, take, name="tactflow.bench")).run()
    if done.error is not None:
        raise TactflowError(done.error)
    return ages


def percentiles(ages: list[float]) -> dict[str, float]:
    """Median, 99th and 99.9th percentile, ms."""
    names = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9}
    return {name: float(np.percentile(ages, share)) for name, share in names.items()} if ages else {}
