"""Runs a pipeline: one thread per segment, one tick per frame."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

from tactflow.engine.conformance import build
from tactflow.engine.contract import Part, Recorder, Source
from tactflow.engine.errors import ConfigError, SourceError, StageError, TactflowError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.link import Link
from tactflow.engine.node import UNCONNECTED, RunningNode, Slots, TickState
from tactflow.engine.plan import Plan, make_plan
from tactflow.engine.segment import NewReferences, NodeFailedError, Segment
from tactflow.engine.stats import Durations, NodeStats
from tactflow.system.signals import INTERRUPTED

logger = logging.getLogger("tactflow")

CLOSE_SECONDS = 10.0
"""Time without progress after which a stopped run reports the hanging stage, s. Chosen by hand: the slowest
stage takes a second."""
LEAVE_SECONDS = 1.0
"""Time for threads to end after an interrupt, s. Chosen by hand: the slowest stage takes as long."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """The outcome of a run.

    error : the error that ended it, or None; failure : the same as an exception. stats : as in the statistics
    file.
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

    pipeline : validated. max_frames : stop after this number of captured frames. check : check values against
    their port types, and pass read-only inputs.

    Raises
    ------
    ConfigError
        If the pipeline cannot be planned, or `max_frames` is less than 1. Nothing was started.
    """

    def __init__(self, pipeline: Pipeline, *, max_frames: int | None = None, check: bool = False) -> None:
        if max_frames is not None and max_frames < 1:
            raise ConfigError(f"max_frames: required a whole number from 1, got {max_frames}")
        self.pipeline = pipeline
        self.max_frames = max_frames
        self.check = check
        self.latency = Durations()
        self.nodes: dict[str, RunningNode] = {}
        self.plan: Plan = make_plan(pipeline)
        ports = [(id_, port.name) for id_, n in pipeline.nodes.items() for port in n.component.ports.outputs]
        self.slots: Slots = {port: slot for slot, port in enumerate(ports, start=UNCONNECTED + 1)}
        self._links: list[Link[TickState]] = []
        self._segments: dict[str, Segment] = {}
        self._threads: dict[str, threading.Thread] = {}
        self._opened: list[tuple[str, Part]] = []
        self._lock = threading.Lock()
        self._error: TactflowError | None = None
        self._end: str | None = None
        self._frames = 0
        self._began = 0.0
        source = pipeline.source
        self._source_segment = self.plan.segment_of(source.id)
        self._source_slot = self.slots[source.id, source.component.ports.outputs[0].name]
        self._source_stats = NodeStats()
        self._stopping = threading.Event()
        self.hurried = False
        self._interrupted = False
        self._turn = threading.Condition()
        self.paused = False
        self._steps = 0
        self.source: Source | None = None

    # -- life cycle ---------------------------------------------------------------------------------------

    def run(
        self, on_progress: Callable[[Progress], None] | None = None, interval_s: float = 0.1
    ) -> RunResult:
        """Open everything, run to the end of the source, close everything.

        Returns errors in the result instead of raising them. A KeyboardInterrupt in this thread ends the run
        immediately; if the run is being closed, it is raised afterwards.

        on_progress : called in this thread about every `interval_s` seconds.
        """
        self._began = time.perf_counter()
        try:
            self._open()
            # Opening a camera may take long.
            self._began = time.perf_counter()
            if not self._stopping.is_set():
                self._start()
                self._wait(on_progress, interval_s)
        except TactflowError as failure:
            self.fail(failure)
        except KeyboardInterrupt:
            self._interrupted = True
            self.stop("signal")
            for link in self._links:
                link.abort()
            until = time.perf_counter() + LEAVE_SECONDS
            for thread in self._threads.values():
                # The interrupt may have come before the start of the thread.
                if thread.is_alive():
                    thread.join(max(0.0, until - time.perf_counter()))
        finally:
            self._close()
        stats, error = self.snapshot(), self._error
        if self._interrupted:
            return RunResult(INTERRUPTED, None, stats)
        if error is not None:
            return RunResult(error.exit_code, str(error), stats, error)
        return RunResult(0, None, stats)

    def stop(self, reason: str = "signal") -> None:
        with self._lock:
            self._end = self._end or reason
            self.hurried = self.hurried or reason != "max_frames"
        self._stopping.set()
        with self._turn:
            self._turn.notify_all()
        if self.source is not None:
            self.source.stop()

    def fail(self, error: TactflowError, cause: BaseException | None = None) -> None:
        """Stop the run because of an error; the first one is reported."""
        if cause is not None:
            error.__cause__ = cause
            logger.debug("%s", "".join(traceback.format_exception(cause)))
        with self._lock:
            if self._error is None:
                self._error = error
                self._end = f"error: {str(error).splitlines()[0]}"
        self.stop(f"error: {error}")

    def retake_reference(self) -> None:
        if self.source is not None:
            self.source.retake()

    def pause(self, paused: bool) -> None:
        with self._turn:
            self.paused = paused
            self._steps = 0
            self._turn.notify_all()

    def step(self) -> None:
        # Pending steps are discarded on resuming.
        with self._turn:
            self._steps += self.paused
            self._turn.notify_all()

    def recorder(self) -> Recorder | None:
        sinks = [node.sink for node in list(self.nodes.values())]
        return next((sink for sink in sinks if isinstance(sink, Recorder)), None)

    def progress(self) -> Progress:
        """The progress so far."""
        dropped = sum(self._dropped())
        return Progress(self._frames, dropped, time.perf_counter() - self._began)

    # -- opening and closing ------------------------------------------------------------------------------

    def _open(self) -> None:
        """Open the source first, then stages, then sinks, so that a missing recording truncates no file."""
        pipeline = self.pipeline
        source = self._build(pipeline.source, SourceError)
        assert isinstance(source, Source)
        self.source = source
        self.plan = make_plan(pipeline, live=source.live)
        pruned = {node.id for node in self.plan.pruned}
        for node in pipeline.nodes.values():
            if self._stopping.is_set():
                # Open nothing more, so that a run without frames empties no file.
                return
            if node.component.kind == "source" or node.id in pruned:
                continue
            instance = self._build(node, StageError)
            self.nodes[node.id] = RunningNode(
                node, instance, self.slots, skipping=pipeline.skipping, check=self.check
            )
        for running in self.nodes.values():
            if running.sink is not None:
                with _located(running.node, StageError):
                    running.sink.begin()

    def _build(self, node: Node, kind: type[TactflowError]) -> Part:
        """Construct and open the part of a node."""
        pipeline = self.pipeline
        offered = {
            "sensor": pipeline.sensor,
            "directory": pipeline.directory,
            "skipping": pipeline.skipping,
            "control": self,
            "calibration": pipeline.calibration,
        }
        with _located(node, kind):
            instance = build(node.component.make, node.params, offered)
            self._opened.append((node.id, instance))
            instance.open()
        return instance

    def _start(self) -> None:
        """Connect the segments and start their threads."""
        for name in self.plan.segments:
            self._segments[name] = Segment(name, self)
        for link_plan in self.plan.links:
            link: Link[TickState] = Link(link_plan.name, link_plan.capacity, link_plan.when_full)
            self._links.append(link)
            consumer = self._segments[link_plan.consumer]
            consumer.inputs.append(link)
            sinks = frozenset(node.id for node in consumer.nodes) if consumer.only_sinks else None
            self._segments[link_plan.producer].outputs.append((link, sinks))
        self._lead_new_references()
        for name, segment in self._segments.items():
            target = self._capture if name == self._source_segment else segment.loop
            self._threads[name] = threading.Thread(target=target, name=f"tactflow-{name}", daemon=True)
        for thread in self._threads.values():
            thread.start()

    def _lead_new_references(self) -> None:
        """Let the first segment with stages turn frames into references on request: a source runs ahead."""
        first = self._segments[self._source_segment]
        if first.only_sinks:
            consumers = [link.consumer for link in self.plan.links if link.producer == first.name]
            with_stages = [s for s in map(self._segments.get, consumers) if s and not s.only_sinks]
            if len(with_stages) != 1:
                return
            first = with_stages[0]
        takers = [id_ for id_, n in self.nodes.items() if n.node.component.delivery.takes_references]
        first.references = NewReferences(self._source_slot, takers)

    @property
    def _is_live(self) -> bool:
        return self.source is not None and self.source.live

    def _wait(self, on_progress: Callable[[Progress], None] | None, interval_s: float) -> None:
        """Wait for the threads: without limit for the end of the source, with a limit after a stop."""
        done, since = -1, time.perf_counter()
        while alive := [name for name, thread in self._threads.items() if thread.is_alive()]:
            self._threads[alive[0]].join(interval_s)
            if on_progress is not None:
                on_progress(self.progress())
            # Draining a long queue counts as progress.
            before, done = done, sum(s.calls for s in self._segments.values())
            done += sum(link.delivered for link in self._links)
            now = time.perf_counter()
            if done != before or not self.hurried:
                since = now
            elif now - since > CLOSE_SECONDS:
                places = [f"{name} (in {self._segments[name].current or 'its source'})" for name in alive]
                for link in self._links:
                    link.abort()
                raise StageError(
                    f"the run was stopped, but has made no progress for {CLOSE_SECONDS:g} s: "
                    f"{', '.join(places)} hangs"
                )

    def _close(self) -> None:
        """Close all opened parts in reverse order, even if some fail.

        A part that a thread still uses is not closed: closing a video while it is read, or a file while it is
        written, may block forever.
        """
        in_use = {self._segments[name].current for name, t in self._threads.items() if t.is_alive()}
        opened, self._opened = self._opened, []
        # An interrupt during one of them is raised after closing the others.
        with ExitStack() as stack:
            for node_id, instance in opened:
                if node_id not in in_use:
                    stack.callback(self._close_part, node_id, instance)

    def _close_part(self, node_id: str, instance: Part) -> None:
        try:
            instance.close()
        except Exception as error:
            self.fail(StageError(f"{node_id}: closing failed: {error}"), error)

    # -- the source's thread ------------------------------------------------------------------------------

    def _capture(self) -> None:
        """Body of the source's thread."""
        segment, node = self._segments[self._source_segment], self.pipeline.source
        try:
            self._capture_frames(segment)
        except NodeFailedError:
            pass
        except TactflowError as error:
            self.fail(SourceError(f"{node.id} ({node.mark}): {error}"))
        except BaseException as error:
            self.fail(SourceError(f"{node.id} ({node.mark}): {type(error).__name__}: {error}"), error)
        finally:
            with self._lock:
                self._end = self._end or "eos"
            self._stopping.set()
            for link, _ in segment.outputs:
                link.close()

    def _capture_frames(self, segment: Segment) -> None:
        assert self.source is not None
        name, slots = self.pipeline.source.id, UNCONNECTED + 1 + len(self.slots)
        sinks = [node for node in self.nodes.values() if node.sink is not None]
        frames = iter(self.source.frames())
        index = 0
        while not self._stopping.is_set():
            segment.current = name
            began = time.perf_counter()
            try:
                frame = next(frames, None)
            finally:
                segment.current = None
            if frame is None:
                return
            if self.paused and not self._may_go_on():
                continue
            ended = time.perf_counter()
            if not frame.captured:
                frame = replace(frame, captured=ended)
            self._source_stats.durations.add(ended - began)
            self._frames += frame.seq >= 0
            demand = frozenset([node.id for node in sinks if _wants(node, frame)])
            tick = TickState(index, frame, demand, slots)
            tick.values[self._source_slot] = frame
            index += 1
            segment.handle(tick)
            if self.max_frames is not None and self._frames >= self.max_frames:
                self.stop("max_frames")

    def _may_go_on(self) -> bool:
        """While paused, whether to process the captured frame; a recording waits for that."""
        with self._turn:
            if not self._is_live:
                self._turn.wait_for(lambda: not self.paused or self._steps or self._stopping.is_set())
            go = not self.paused or self._steps > 0
            self._steps = max(0, self._steps - 1)
            return go and not self._stopping.is_set()

    # -- statistics ---------------------------------------------------------------------------------------

    def _dropped(self) -> tuple[int, int]:
        """Frames dropped before the first segment of stages, and replaced within the source."""
        source = self._segments.get(self._source_segment)
        links = [link for link, only_sinks in source.outputs if only_sinks is None] if source else []
        missed = 0 if self.source is None else self.source.missed
        return max((link.drops for link in links), default=0), missed

    def snapshot(self) -> dict[str, Any]:
        # A sink may call this while others are still being opened.
        nodes = list(self.nodes.values())
        dropped, missed = self._dropped()
        stages = {node.id: node.stats.entry() for node in nodes if node.sink is None}
        return {
            "frames": self._frames - dropped,
            "dropped": dropped + missed,
            "wall_s": round(time.perf_counter() - self._began, 6),
            **({} if self._end is None else {"end": self._end}),
            "stages": {self.pipeline.source.id: self._source_stats.entry(), **stages},
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
            "links": {link.name: link.stats() for link in self._links},
            "latency_ms": {"p50": self.latency.milliseconds(0.5), "p99": self.latency.milliseconds(0.99)},
        }


@contextmanager
def _located(node: Node, kind: type[TactflowError]) -> Iterator[None]:
    """Add the node and its line to errors of opening it."""
    try:
        yield
    except kind as error:
        raise kind(f"{node.id} ({node.mark}): {error}") from error
    except TactflowError:
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise kind(
            f"{node.id} ({node.mark}): cannot be opened: {type(error).__name__}: {error}\n"
            f"  in {place.filename}:{place.lineno}"
        ) from error


def _wants(node: RunningNode, frame: Frame) -> bool:
    """Whether a node is a sink that wants a frame.

    A sink that takes references gets all of them; others get no reference image from outside the source.
    """
    sink = node.sink
    if sink is None or node.disabled:
        return False
    if frame.reference and node.node.component.delivery.takes_references:
        return True
    return frame.seq >= 0 and node.rate_limit.due(frame.t) and sink.wants()
