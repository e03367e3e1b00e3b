"""Whole pipelines, taking turns.

Each pipeline runs in the real engine with all its stages in one segment, and so in one thread. The source
holds this thread until it is its turn, and then lets it run through the frames of the turn. So pipelines can
be compared with each other (A B A B ...) in one process, and the measured time is the whole cost of a frame,
including the encoding of its message. The frames of a turn are read before the clock runs: they lie in
memory then, as a camera's do, and not in the cache.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import wraps
from itertools import islice
from pathlib import Path
from typing import Any

from tactflow.api import make_runner
from tactflow.engine.collect import with_collector
from tactflow.engine.contract import Part, StageParams
from tactflow.engine.errors import TactflowError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline, Queue
from tactflow.engine.run import RunResult
from tactflow.message.result import Result, encode_message
from tactflow.tools.bench.timing import TURN_FRAMES, Times, quiet
from tactflow.vision.geometry import PixelMapping


class TimedResult(Result):
    """The result of a pipeline for a frame, and its cost.

    Attributes
    ----------
    mapping : from raw to processed pixels, or None.
    cpu_s : CPU time, s.
    """

    mapping: PixelMapping | None
    cpu_s = 0.0


class LockstepPipeline:
    """One pipeline, run a few frames at a time.

    Parameters
    ----------
    pipeline : as loaded; its source must be the recording to run on. Its sinks do not run.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._turns: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        """For the pipeline's thread: how many frames to let through, or None to stop."""
        self._done: queue.SimpleQueue[RunResult | None] = queue.SimpleQueue()
        """For the bench, after each turn: how the run ended, or None if it goes on."""
        self._results: list[TimedResult] = []
        self._outcome: RunResult | None = None
        self._runner = make_runner(self._in_one_thread(pipeline))
        self._thread = threading.Thread(target=self._run, name="tactflow-bench", daemon=True)
        self._thread.start()

    def block(self, frames: int = TURN_FRAMES) -> list[TimedResult]:
        """Run a number of further frames without a pause between them, and return their results.

        Returns fewer where the recording ends or the pipeline fails. The next call then returns an empty
        list, or raises TactflowError if the pipeline failed.
        """
        if self._outcome is None:
            self._turns.put(frames)
            self._outcome = self._done.get()
        results, self._results = self._results, []
        if not results and self._outcome is not None and self._outcome.error is not None:
            raise TactflowError(self._outcome.error)
        return results

    def close(self) -> None:
        """Stop, and wait for the pipeline's thread."""
        self._runner.stop("max_frames")
        self._turns.put(None)
        self._thread.join()

    def _run(self) -> None:
        self._done.put(self._runner.run())

    def _take(self, result: TimedResult) -> None:
        encode_message(result)
        self._results.append(result)

    def _frames(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """Hand out frames in turns, and note what each of them cost."""
        while (count := self._turns.get()) is not None:
            turn = list(islice(frames, count))
            for frame in turn:
                known = len(self._results)
                began = time.thread_time()
                yield frame
                cpu_s = time.thread_time() - began
                # A reference image from outside the recording has no result.
                for result in self._results[known:]:
                    result.cpu_s = cpu_s
            if len(turn) < count:
                return
            self._done.put(None)

    def _in_one_thread(self, pipeline: Pipeline) -> Pipeline:
        """The same graph in one segment, with frames in turns and a sink that keeps the results."""
        component = pipeline.source.component

        @wraps(component.make)
        def make(*args: Any, **offered: Any) -> Part:
            source: Any = component.make(*args, **offered)
            frames = source.frames
            source.frames = lambda: self._frames(frames())
            return source  # type: ignore[no-any-return]

        collecting = with_collector(pipeline, TimedResult, self._take, name="tactflow.bench")
        segment = pipeline.source.segment or "capture"
        nodes = {
            name: replace(node, segment=segment, queue=Queue()) for name, node in collecting.nodes.items()
        }
        source = nodes[pipeline.source.id]
        nodes[source.id] = replace(source, component=replace(component, make=make))
        return replace(collecting, nodes=nodes, opencv_threads=1)


def with_params(pipeline: Pipeline, stage: str, params: StageParams) -> Pipeline:
    """The same pipeline with other parameters of a stage."""
    return replace(pipeline, nodes={**pipeline.nodes, stage: replace(pipeline.nodes[stage], params=params)})


def on_recording(pipeline: Pipeline, path: Path) -> Pipeline:
    """The same pipeline reading another recording."""
    return with_params(pipeline, pipeline.source.id, pipeline.source.params.changed(source=str(path)))


def take_turns(
    pipelines: Mapping[str, Pipeline],
    observe: Callable[[str, TimedResult], str],
    block: int = TURN_FRAMES,
    limit_s: float = math.inf,
) -> tuple[dict[str, Times], dict[str, str]]:
    """Run pipelines in turns of a few frames until all recordings are over.

    pipelines : name -> pipeline, each with its recording. observe : called with (name, result) for each
    frame, after its turn; returns the kind of frame its time belongs to, except for references.
    block : frames in a turn. limit_s : CPU time after which a pipeline is stopped, and counts as failed.

    Returns times : name -> kind of frame -> CPU times, s. failures : name -> why it stopped.
    """
    times: dict[str, Times] = {name: defaultdict(list) for name in pipelines}
    failures: dict[str, str] = {}
    running: dict[str, LockstepPipeline] = {}
    with quiet(), ExitStack() as stack:
        for name, pipeline in pipelines.items():
            try:
                running[name] = stack.enter_context(closing(LockstepPipeline(pipeline)))
            except TactflowError as error:
                failures[name] = str(error)
        while running:
            for name in list(running):
                try:
                    results = running[name].block(block)
                except TactflowError as error:
                    failures[name], results = str(error), []
                for result in results:
                    kind = observe(name, result)
                    times[name]["reference" if result.frame.reference else kind].append(result.cpu_s)
                if sum(map(sum, times[name].values())) > limit_s:
                    failures[name] = f"takes more than {limit_s:g} s"
                if not results or name in failures:
                    del running[name]
    return times, failures
