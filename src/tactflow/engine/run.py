"""Runs a pipeline: one thread per segment, one tick per frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from tactflow.engine.capturing import Capturing
from tactflow.engine.contract import Recorder, Source
from tactflow.engine.ending import Ending
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.engine.node import RunningNode
from tactflow.engine.parts import Parts
from tactflow.engine.plan import Plan, make_plan
from tactflow.engine.threads import Threads
from tactflow.system.signals import INTERRUPTED_EXIT_CODE


@dataclass(frozen=True, slots=True)
class RunResult:
    """The outcome of a run.

    Attributes
    ----------
    error : the error that ended it, or None.
    failure : the same as an exception.
    stats : as in the statistics file.
    """

    exit_code: int
    error: str | None
    stats: Mapping[str, Any]
    failure: TactflowError | None = None


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run."""

    frames: int
    dropped: int
    elapsed_s: float


class Runner:
    """One run of a pipeline. Its interface for sinks is documented in `tactflow.engine.control.Control`.

    Parameters
    ----------
    pipeline : validated.
    max_frames : stop after this number of captured frames.
    check : check values against their port types, and pass read-only inputs.
    offered : further arguments that constructors of parts may take by name.

    Attributes
    ----------
    plan : of the segments.
    nodes : id -> open stage or sink.
    source : once it is open.

    Raises
    ------
    ConfigError
        If the pipeline cannot be planned, or `max_frames` is less than 1. Nothing was started.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        *,
        max_frames: int | None = None,
        check: bool = False,
        offered: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        if max_frames is not None and max_frames < 1:
            raise ConfigError(f"max_frames: required a whole number from 1, got {max_frames}")
        self.pipeline = pipeline
        self.max_frames = max_frames
        self.plan: Plan = make_plan(pipeline)
        self._ending = Ending(self._wake)
        self._parts = Parts(pipeline, self, offered, check=check)
        self._capturing = Capturing(pipeline.source, self._parts.slots, self._ending, max_frames)
        self._threads = Threads(self._ending, self.retake_reference)
        self._began = 0.0

    def run(
        self, on_progress: Callable[[Progress], None] | None = None, interval_s: float = 0.1
    ) -> RunResult:
        """Open everything, run to the end of the source, close everything.

        Returns errors in the result instead of raising them. A KeyboardInterrupt in this thread ends the run
        immediately; if the run is being closed, it is raised afterwards.

        on_progress : called in this thread about every `interval_s` seconds.
        """
        self._began = time.perf_counter()
        is_interrupted = False
        try:
            source = self._open()
            # Opening a camera may take long.
            self._began = time.perf_counter()
            if not self._ending.stopping.is_set():
                self._start(source)
                for _ in self._threads.wait(interval_s):
                    if on_progress is not None:
                        on_progress(self.progress())
        except TactflowError as failure:
            self._ending.fail(failure)
        except KeyboardInterrupt:
            is_interrupted = True
            self.stop("signal")
            self._threads.leave()
        finally:
            self._parts.close(self._threads.in_use, self._ending.fail)
        stats, error = self.snapshot(), self._ending.error
        if is_interrupted:
            return RunResult(INTERRUPTED_EXIT_CODE, None, stats)
        if error is not None:
            return RunResult(error.exit_code, str(error), stats, error)
        return RunResult(0, None, stats)

    def _open(self) -> Source:
        source = self._parts.open_source()
        self.plan = make_plan(self.pipeline, live=source.live)
        self._parts.open_nodes(self.plan.pruned, self._ending.stopping)
        return source

    def _start(self, source: Source) -> None:
        """Start the threads; the first takes frames for the sinks."""
        sinks = [node for node in self.nodes.values() if node.sink is not None]
        self._threads.start(
            self.plan,
            self.nodes,
            self._capturing.slot,
            lambda segment: self._capturing.loop(source, sinks, segment),
        )

    @property
    def nodes(self) -> Mapping[str, RunningNode]:
        """The open stages and sinks."""
        return self._parts.nodes

    @property
    def source(self) -> Source | None:
        return self._parts.source

    @property
    def paused(self) -> bool:
        return self._capturing.paused

    @property
    def hurried(self) -> bool:
        return self._ending.hurried

    def stop(self, reason: str = "signal") -> None:
        self._ending.stop(reason)

    def _wake(self) -> None:
        """Interrupt what waits for a frame."""
        self._capturing.wake()
        if self.source is not None:
            self.source.stop()

    def pause(self, paused: bool) -> None:
        self._capturing.pause(paused)

    def step(self) -> None:
        self._capturing.step()

    def retake_reference(self) -> None:
        if self.source is not None:
            self.source.retake()

    def recorder(self) -> Recorder | None:
        sinks = [node.sink for node in list(self.nodes.values())]
        return next((sink for sink in sinks if isinstance(sink, Recorder)), None)

    @property
    def _missed(self) -> int:
        """Number of frames replaced within the source."""
        return 0 if self.source is None else self.source.missed

    def progress(self) -> Progress:
        """The progress so far."""
        dropped = self._threads.dropped + self._missed
        return Progress(self._capturing.frames, dropped, time.perf_counter() - self._began)

    def snapshot(self) -> dict[str, Any]:
        # A sink may call this while others are still being opened.
        nodes = list(self.nodes.values())
        dropped, latency = self._threads.dropped, self._threads.latency
        end = {} if self._ending.reason is None else {"end": self._ending.reason}
        stages = {node.id: node.stats.entry() for node in nodes if node.sink is None}
        return {
            "frames": self._capturing.frames - dropped,
            "dropped": dropped + self._missed,
            "wall_s": round(time.perf_counter() - self._began, 6),
            **end,
            "stages": {self.pipeline.source.id: self._capturing.stats.entry(), **stages},
            "sinks": {
                node.id: node.stats.entry() | {"counters": dict(node.sink.counters())}
                for node in nodes
                if node.sink is not None
            },
            "signals": {
                f"{node.id}.{port}": signal.entry()
                for node in nodes
                for port, (_, signal) in (node.signals | node.presences).items()
            },
            "links": {link.name: link.stats() for link in list(self._threads.links)},
            "latency_ms": {"p50": latency.milliseconds(0.5), "p99": latency.milliseconds(0.99)},
        }
