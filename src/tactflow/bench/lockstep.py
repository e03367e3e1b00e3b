"""Whole pipelines, taking turns.

Each pipeline runs in the real engine with all its nodes in one segment, so in one thread that takes a frame,
computes, writes its JSON line, and comes back for the next frame. Here that thread is held at the source
until it is its turn, and then runs freely through as many frames as the turn has. So pipelines can be
compared with each other (A B A B ...) in one process, and the measured time is everything a frame costs in a
pipeline that streams, writing included, and nothing else.

Reading a file is not: the clock stands while the next frames are read, some at a time, so that they lie in
memory as a camera's do, and not in the cache.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.api import make_runner
from tactflow.bench.timing import BLOCK
from tactflow.config.registry import resolve
from tactflow.engine.conformance import own_sink
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import TactflowError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Mark, Node, Pipeline, Queue
from tactflow.engine.run import RunResult
from tactflow.ports import ContactMask, Image
from tactflow.sources import open_source
from tactflow.sources.base import FrameReader, StampedReader
from tactflow.sources.first import Ahead
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Contact, Flow, Markers

_PATIENCE = 120.0
"""How long one frame of one pipeline may take, s; a hanging plug-in must not hang the bench for ever."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a pipeline said about one frame, and what that cost.

    cpu, wall : s; computing, and writing the line. The others as in the result message.
    """

    frame: Frame
    contact: Contact | None
    flow: Flow | None
    markers: Markers | None
    contact_mask: NDArray[np.uint8] | None
    mapping: PixelMapping | None
    image: NDArray[np.uint8] | None
    cpu: float
    wall: float


class _Found(NamedTuple):
    """What is kept of a frame; each is None where it was not computed, or no stage makes it."""

    contact: Contact | None = None
    flow: Flow | None = None
    markers: Markers | None = None
    contact_mask: ContactMask | None = None
    mapping: PixelMapping | None = None
    image: Image | None = None


class _Collect(Sink):
    """Keeps the last frame's values for the bench."""

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.last = _Found()

    def write(self, found: _Found) -> None:
        self.last = found


class _Turns:
    """Hands turns to the pipeline's thread, and takes them back with what it said and how long that took.

    Parameters
    ----------
    keep : called in the pipeline's thread with a frame's CPU and wall time, s, between the timed parts.
    """

    def __init__(self, keep: Callable[[float, float], None]) -> None:
        self._keep = keep
        self._go = threading.Semaphore(0)
        self._done = threading.Semaphore(0)
        self._granted = 0
        self._left = 0
        self._finished = 0
        self._ended = False
        self._start: tuple[float, float] | None = None

    def take(self, frames: int) -> bool:
        """For the bench: let so many frames through, in one go; False if the recording ended before that."""
        if self._ended:
            return False
        self._granted = frames
        self._go.release()
        finished = self._finished
        while not self._done.acquire(timeout=_PATIENCE):
            if self._finished == finished:
                raise TactflowError(f"one frame took more than {_PATIENCE:g} s")
            finished = self._finished
        return not self._ended

    def wait(self) -> bool:
        """For the pipeline's thread, in front of a frame: report the last one and wait. False to stop."""
        if self._start is not None:
            cpu = time.thread_time() - self._start[0]
            wall = time.perf_counter() - self._start[1]
            self._start = None
            self._keep(cpu, wall)
            self._finished += 1
            self._left -= 1
            if not self._left:
                self._done.release()
        if not self._left:
            self._go.acquire()
            self._left = self._granted
        if self._ended:
            return False
        self._start = (time.thread_time(), time.perf_counter())
        return True

    @contextmanager
    def paused(self) -> Iterator[None]:
        """For the pipeline's thread: what happens in this block is no part of a frame's time."""
        cpu, wall = time.thread_time(), time.perf_counter()
        yield
        if self._start is not None:
            cpu, wall = time.thread_time() - cpu, time.perf_counter() - wall
            self._start = (self._start[0] + cpu, self._start[1] + wall)

    def end(self) -> None:
        """No more frames; from either side."""
        self._ended = True
        self._go.release()
        self._done.release()


class LockstepPipeline:
    """One pipeline, run a few frames at a time.

    Parameters
    ----------
    pipeline : as loaded; its source must be the recording to run on. Its sinks are replaced by `jsonl`.
    jsonl : where the JSON lines go, or None for no JSON lines.
    """

    def __init__(self, pipeline: Pipeline, jsonl: Path | None) -> None:
        self._turns = _Turns(self._keep)
        self._outcomes: list[Outcome] = []
        self._runner = make_runner(_rewired(pipeline, jsonl, self._turns))
        self._result: RunResult | None = None
        self._thread = threading.Thread(target=self._run, name="tactflow-bench", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._result = self._runner.run()
        finally:
            self._turns.end()

    def _keep(self, cpu: float, wall: float) -> None:
        collect: Any = self._runner.nodes[_COLLECT].instance
        source: Any = self._runner.source
        found = collect.last._asdict()
        self._outcomes.append(Outcome(frame=source.last_frame, **found, cpu=cpu, wall=wall))

    def block(self, frames: int) -> list[Outcome]:
        """Run the next frames without a pause between them.

        Parameters
        ----------
        frames : how many, >= 1. What they say is kept until all are done, so this many results of the
            pipeline must fit into memory.

        Returns
        -------
        What was said about each. Fewer than asked for where the recording ends or the pipeline fails; the
        call after that returns an empty list or raises.

        Raises
        ------
        TactflowError
            If the pipeline failed and there is nothing left to return.
        """
        complete = self._turns.take(frames)
        outcomes, self._outcomes = self._outcomes, []
        if not complete and not outcomes:
            self._thread.join(_PATIENCE)
            if self._result is not None and self._result.error is not None:
                raise TactflowError(self._result.error)
        return outcomes

    def step(self) -> Outcome | None:
        """Run the next frame alone; None at the end of the recording.

        Raises
        ------
        TactflowError
            If the pipeline failed.
        """
        return next(iter(self.block(1)), None)

    def stages_ms(self) -> dict[str, float]:
        """Stage or sink -> median time of a call so far, ms."""
        medians = {
            node.id: node.stats.durations.milliseconds(0.5)
            for node in self._runner.nodes.values()
            if node.id != _COLLECT
        }
        return {name: value for name, value in medians.items() if value is not None}

    def close(self) -> None:
        """Stop, and wait for the pipeline's thread."""
        self._runner.stop("max_frames")
        self._turns.end()
        self._thread.join(_PATIENCE)


_COLLECT = "bench"
"""Id of the sink that takes each frame's results."""


class _InMemory:
    """A recording whose frames are read some at a time, while the clock stands."""

    def __init__(self, reader: FrameReader, turns: _Turns) -> None:
        self.live, self.fps, self.size, self.total = reader.live, reader.fps, reader.size, reader.total
        self.description, self.close = reader.description, reader.close
        self._ahead = Ahead(reader)
        self._turns = turns
        self._ready = 0

    def read(self) -> tuple[NDArray[np.uint8], float] | None:
        """The next frame; as `FrameReader.read`."""
        if not self._ready:
            with self._turns.paused():
                while self._ready < BLOCK and self._ahead.peek() is not None:
                    self._ready += 1
        self._ready = max(self._ready - 1, 0)
        return self._ahead.read()


def _lockstep_source(cls: type, turns: _Turns) -> type:
    """The source class, held before every frame until it is its turn."""

    def open_in_memory(*args: Any, **options: Any) -> Any:
        reader = open_source(*args, **options)
        return reader if isinstance(reader, StampedReader) else _InMemory(reader, turns)

    takes = signature(cls)
    reads = {"opener": open_in_memory} if "opener" in takes.parameters else {}

    class Lockstep(cls):  # type: ignore[misc]
        # The engine offers what the source asks for.
        __signature__ = takes
        last_frame: Frame | None = None

        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options, **reads)

        def frames(self) -> Iterator[Frame]:
            frames = super().frames()
            while turns.wait():
                frame = next(frames, None)
                if frame is None:
                    return
                self.last_frame = frame
                yield frame

    return Lockstep


def _rewired(pipeline: Pipeline, jsonl: Path | None, turns: _Turns) -> Pipeline:
    """The same graph in one segment, with the bench's source in front and its sinks behind."""
    source = pipeline.source
    segment = source.segment or "capture"
    nodes: dict[str, Node] = {}
    for node in pipeline.nodes.values():
        if node.component.kind == "sink":
            continue
        node = replace(node, segment=segment, queue=Queue())
        if node.id == source.id:
            node = replace(
                node, component=replace(node.component, cls=_lockstep_source(node.component.cls, turns))
            )
        nodes[node.id] = node
    if jsonl is not None:
        component = resolve("jsonl", "sinks", pipeline.directory)
        params = component.params.model_validate({"path": str(jsonl), "overwrite": True})
        inputs = {port.name: pipeline.last_output(port.name) for port in component.ports.inputs}
        nodes["jsonl"] = Node("jsonl", component, params, inputs, Mark("bench", 0, 0), segment=segment)
    nodes[_COLLECT] = replace(own_sink(pipeline, _Collect, _COLLECT, "bench"), segment=segment)
    return replace(pipeline, nodes=nodes, opencv_threads=1)
