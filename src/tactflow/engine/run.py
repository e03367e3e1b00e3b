"""Runs a planned pipeline: one thread a segment, one tick a frame.

In a segment, values are pulled: only what a sink asks for in this tick, and what a stateful stage must
see, is computed, each node at most once. A gate is looked at before the inputs of its stage, so a closed
gate never runs what only that stage needs.
"""

from __future__ import annotations

import inspect
import logging
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from tactflow.engine.check import ArrayCheck
from tactflow.engine.errors import SourceError, StageError, TactflowError
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.engine.graph import Gate, Node, Pipeline
from tactflow.engine.link import Link
from tactflow.engine.plan import Plan, make_plan
from tactflow.engine.stage import Port, SignalPort, port_type
from tactflow.engine.stats import Durations, NodeStats, SignalStats

logger = logging.getLogger("tactflow")

Key = tuple[str, str]
"""A port of a node: (node id, port name)."""

INTERRUPTED = 130
"""Exit code of a run that was not allowed to finish the frames under way."""

CLOSE_SECONDS = 10.0
"""How long the threads may take to end after the stream has ended, before the one that hangs is named."""


class Source(Protocol):
    """What a source stage offers to the runner. `stop` must make `frames` end soon, from any thread."""

    live: bool

    def frames(self) -> Iterator[Frame]: ...
    def stop(self) -> None: ...


class RunningTick:
    """One frame's journey: a table of values that segments fill in, each its own part.

    demand : ids of the sinks that want this tick. reasons : why a port was not computed in this tick; a
    port may have both a reason and a value, when its last value was repeated.
    """

    __slots__ = ("demand", "frame", "index", "reasons", "values")

    def __init__(self, index: int, frame: Frame, demand: frozenset[str]) -> None:
        self.index = index
        self.frame = frame
        self.demand = demand
        self.values: dict[Key, Any] = {}
        self.reasons: dict[Key, str] = {}


class _RunningGate:
    """A gate with its memory: frames since it was last open."""

    __slots__ = ("key", "plan", "since_open", "since_true")

    def __init__(self, plan: Gate) -> None:
        self.plan = plan
        self.key: Key = (plan.signal.node, plan.signal.port)
        self.since_true: int | None = None
        self.since_open = 0

    @property
    def has_memory(self) -> bool:
        return self.plan.hold > 0 or self.plan.at_least_every is not None or self.plan.otherwise == "repeat"

    def is_open(self, signal: Any) -> bool:
        """Take in this tick's signal. An absent signal closes the gate."""
        true = signal is not None and not isinstance(signal, Absent) and bool(signal)
        self.since_true = 0 if true else None if self.since_true is None else self.since_true + 1
        every = self.plan.at_least_every
        held = self.since_true is not None and self.since_true <= self.plan.hold
        due = every is not None and self.since_open + 1 >= every
        self.since_open = 0 if held or due else self.since_open + 1
        return held or due

    def reset(self) -> None:
        self.since_true, self.since_open = None, 0


class RunningNode:
    """A stage or sink at run time: the instance, where its inputs come from, what it has done."""

    def __init__(self, node: Node, instance: Any, *, skipping: bool, check: bool) -> None:
        self.node = node
        self.id = node.id
        self.instance = instance
        self.is_sink = node.component.kind == "sink"
        self.function: Callable[..., Any] = getattr(
            instance, "write" if self.is_sink else "process", _no_function
        )
        self.inputs: list[tuple[Port, Key | None]] = []
        for port in node.component.ports.inputs:
            ref = node.inputs.get(port.name)
            self.inputs.append((port, (ref.node, ref.port) if ref else None))
        self.names = [port.name for port, _ in self.inputs]
        self.outputs: list[Key] = [(node.id, port.name) for port in node.component.ports.outputs]
        self.gates = [_RunningGate(gate) for gate in node.gates] if skipping else []
        self.stateful = node.component.memory == "stateful" or any(g.has_memory for g in self.gates)
        self.stats = NodeStats()
        self.signals = {
            key: SignalStats()
            for key, port in zip(self.outputs, node.component.ports.outputs, strict=True)
            if isinstance(port_type(port.annotation), SignalPort)
        }
        self.disabled = False
        self.last: list[Any] | None = None
        self.check = ArrayCheck(node) if check else None
        self.next_due = float("-inf")

    @property
    def repeats(self) -> bool:
        return any(gate.plan.otherwise == "repeat" for gate in self.gates)

    def due(self, frame: Frame) -> bool:
        """Whether a rate-limited sink's next time has come; goes by capture time."""
        rate = self.node.max_rate
        if rate is None:
            return True
        # Half a microsecond of slack: times of a recording are multiples of 1 / fps in floating point.
        if frame.t + 5e-7 < self.next_due:
            return False
        start = self.next_due if frame.t - self.next_due < 1.0 / rate else frame.t
        self.next_due = start + 1.0 / rate
        return True

    def reset(self) -> None:
        """A new reference follows: forget what was learned from the last one."""
        self.last = None
        for gate in self.gates:
            gate.reset()
        if hasattr(self.instance, "reset"):
            self.instance.reset()


def _no_function(**_: Any) -> None:
    raise AssertionError("a source is not called")


class _NodeFailedError(Exception):
    """Ends a segment because one of its nodes failed for good."""


class _Segment:
    """Evaluates the nodes of one segment for a tick."""

    def __init__(self, name: str, runner: Runner) -> None:
        self.name = name
        self.runner = runner
        plan = runner.plan
        self.nodes = [runner.nodes[i] for i in plan.segments[name] if i in runner.nodes]
        self.mine = {node.id for node in self.nodes}
        self.known = self.mine | {i for a in plan.ancestors[name] for i in plan.segments[a]}
        below = [i for i in plan.pipeline.nodes if i in runner.nodes and i not in self.known]
        self.stateful = [
            n for n in runner.nodes.values() if n.stateful and (n.id in self.mine or n.id in below)
        ]
        self.sinks = [n for n in runner.nodes.values() if n.is_sink and (n.id in self.mine or n.id in below)]
        self.data_sinks = [n for n in self.nodes if n.is_sink and not getattr(n.instance, "observer", False)]
        self.inputs: list[Link[RunningTick]] = []
        self.outputs: list[tuple[Link[RunningTick], frozenset[str] | None]] = []
        self.epoch = 0
        self.current: str | None = None

    def execute(self, tick: RunningTick) -> None:
        """Compute what this tick needs from this segment."""
        if tick.frame.epoch != self.epoch:
            self.epoch = tick.frame.epoch
            for node in self.nodes:
                node.reset()
        visited: set[str] = set()
        for node in self.stateful:
            self._visit(node, tick, visited)
        for node in self.sinks:
            if node.id in tick.demand:
                self._visit(node, tick, visited)
        for node in self.nodes:
            if node.id not in visited:
                node.stats.skips["no_demand"] += 1
        if self.data_sinks and tick.demand:
            self.runner.latency.add(time.perf_counter() - tick.frame.captured)

    def _visit(self, node: RunningNode, tick: RunningTick, visited: set[str]) -> None:
        """Pull one node. A node of a later segment is only walked through, to what it needs from here."""
        if node.id in visited:
            return
        visited.add(node.id)
        own = node.id in self.mine
        if not own and node.id in self.known:
            return
        reason = None
        for gate in node.gates:
            signal_node = self.runner.nodes.get(gate.key[0])
            if signal_node is not None:
                self._visit(signal_node, tick, visited)
            if own:
                if not gate.is_open(tick.values.get(gate.key)):
                    signal = tick.values.get(gate.key)
                    reason = reason or (signal.reason if isinstance(signal, Absent) else gate.plan.reason)
            elif gate.key[0] in self.known and not gate.plan.hold and gate.plan.at_least_every is None:
                signal = tick.values.get(gate.key)
                if isinstance(signal, Absent) or not signal:
                    return
        if reason is not None:
            self._skip(node, tick, reason, repeat=node.repeats)
            return
        for _, key in node.inputs:
            if key is not None and key[0] in self.runner.nodes:
                self._visit(self.runner.nodes[key[0]], tick, visited)
        if own:
            self._run(node, tick)

    def _skip(self, node: RunningNode, tick: RunningTick, reason: str, *, repeat: bool = False) -> None:
        node.stats.skips[reason] += 1
        values = node.last if repeat and node.last is not None else [Absent(reason)] * len(node.outputs)
        for key, value in zip(node.outputs, values, strict=True):
            tick.values[key] = value
            tick.reasons[key] = reason
            if key in node.signals:
                node.signals[key].add(value is True)

    def _run(self, node: RunningNode, tick: RunningTick) -> None:
        if node.disabled:
            self._skip(node, tick, "disabled")
            return
        arguments: list[Any] = []
        for port, key in node.inputs:
            value = None if key is None else tick.values.get(key)
            if isinstance(value, Absent):
                if not port.optional:
                    self._skip(node, tick, value.reason)
                    return
                value = None
            arguments.append(value)
        if node.check is not None:
            arguments = [node.check.read_only(value) for value in arguments]
        named = dict(zip(node.names, arguments, strict=True))
        if node.node.component.ports.takes_tick:
            named["tick"] = Tick(tick.frame, self._skipped(node, tick))
        self.current = node.id
        began = time.perf_counter()
        try:
            values = _values(node.function(**named), len(node.outputs))
            elapsed = time.perf_counter() - began
            if node.check is not None:
                node.check.outputs(arguments, values)
        except Exception as error:
            self._failed(node, tick, arguments, error)
            return
        finally:
            self.current = None
        node.stats.runs += 1
        node.stats.durations.add(elapsed)
        if node.repeats:
            node.last = values
        for key, value in zip(node.outputs, values, strict=True):
            if isinstance(value, Absent):
                tick.reasons[key] = value.reason
            tick.values[key] = value
            if key in node.signals:
                node.signals[key].add(not isinstance(value, Absent) and bool(value))

    def _skipped(self, node: RunningNode, tick: RunningTick) -> dict[str, str]:
        reasons = tick.reasons
        return {port.name: reasons[key] for port, key in node.inputs if key is not None and key in reasons}

    def _failed(
        self, node: RunningNode, tick: RunningTick, arguments: Sequence[Any], error: Exception
    ) -> None:
        node.stats.errors += 1
        policy = node.node.on_error
        failure = describe_failure(node.node, tick.frame, arguments, error)
        if policy.action == "stop" or (policy.action == "skip_frame" and node.stats.errors > policy.budget):
            if policy.action == "skip_frame":
                failure = StageError(
                    f"{failure}\n  (the budget of {policy.budget} skipped frames is used up)"
                )
            self.runner.fail(failure)
            raise _NodeFailedError
        if policy.action == "disable":
            node.disabled = True
            logger.warning("%s\n  %s is disabled for the rest of the run", failure, node.id)
            self._skip(node, tick, "disabled")
        else:
            logger.warning("%s\n  frame skipped (%d of %d)", failure, node.stats.errors, policy.budget)
            self._skip(node, tick, "error")

    def forward(self, tick: RunningTick) -> None:
        """Hand the tick to the next segments. One that holds only sinks gets it only if one of them asked."""
        keep = tick.frame.reference
        for link, only_sinks in self.outputs:
            if only_sinks is None or not only_sinks.isdisjoint(tick.demand):
                link.put(tick, keep=keep)

    def next_tick(self) -> RunningTick | None:
        """The next tick that all links into this segment have; None at the end of the stream."""
        heads = [link.get() for link in self.inputs]
        while True:
            newest = max((tick.index for tick in heads if tick is not None), default=-1)
            if any(tick is None for tick in heads):
                for link, tick in zip(self.inputs, heads, strict=True):
                    while tick is not None:
                        link.discard()
                        tick = link.get()
                return None
            behind = [i for i, tick in enumerate(heads) if tick is not None and tick.index < newest]
            if not behind:
                return heads[0]
            for i in behind:
                self.inputs[i].discard()
                heads[i] = self.inputs[i].get()

    def loop(self) -> None:
        """Body of the segment's thread."""
        try:
            while (tick := self.next_tick()) is not None:
                self.execute(tick)
                self.forward(tick)
        except _NodeFailedError:
            for link in self.inputs:
                link.abort()
        except BaseException as error:
            self.runner.fail(StageError(f"segment {self.name}: {type(error).__name__}: {error}"), error)
            for link in self.inputs:
                link.abort()
        finally:
            for link, _ in self.outputs:
                link.close()


def _values(result: Any, count: int) -> list[Any]:
    """What a node returned, as one value per output port; None stands for absent."""
    if isinstance(result, Absent) or (result is None and count):
        return [result or Absent("none")] * count
    values = list(result) if isinstance(result, tuple) else [result] if count else []
    if len(values) != count:
        raise TypeError(f"required {count} outputs, got {len(values)}")
    return [Absent("none") if value is None else value for value in values]


def describe_failure(node: Node, frame: Frame, arguments: Sequence[Any], error: Exception) -> StageError:
    """An error that says which node failed on which frame, where in its code, and with what inputs."""
    if isinstance(error, TactflowError):
        return StageError(f"{node.id}, frame {frame.seq} ({node.mark}): {error}")
    place = traceback.extract_tb(error.__traceback__)
    # The first entry is the engine's own call; the second is the node's own code.
    code = place[1] if len(place) > 1 else place[-1]
    where = f"{code.filename}:{code.lineno}"
    if place[-1] is not code:
        where += f" (raised at {place[-1].filename}:{place[-1].lineno})"
    inputs = ", ".join(
        f"{port.name}: {describe_value(value)}"
        for port, value in zip(node.component.ports.inputs, arguments, strict=True)
    )
    return StageError(
        f"{node.id} failed at frame {frame.seq}: {type(error).__name__}: {error}\n"
        f"  in {where}\n  set up at {node.mark}\n  inputs: {inputs or 'none'}"
    )


def describe_value(value: Any) -> str:
    """Shape and dtype of an array, else the type's name."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{tuple(value.shape)} {value.dtype}"
    return "absent" if value is None else type(value).__name__


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended. error : None, or why it stopped. stats : as in the statistics file."""

    exit_code: int
    error: str | None
    stats: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Progress:
    """A glance at a run that is under way."""

    frames: int
    dropped: int
    elapsed_s: float


class Runner:
    """One run of a pipeline.

    pipeline : validated. max_frames : stop after so many captured frames. check : check arrays against
    their port types, and hand inputs over read-only, in every tick.

    Raises
    ------
    ConfigError
        If the pipeline cannot be planned. Nothing was started.
    """

    def __init__(self, pipeline: Pipeline, *, max_frames: int | None = None, check: bool = False) -> None:
        self.pipeline = pipeline
        self.max_frames = max_frames
        self.check = check
        self.latency = Durations()
        self.nodes: dict[str, RunningNode] = {}
        self.plan: Plan = make_plan(pipeline)
        self._links: list[Link[RunningTick]] = []
        self._segments: dict[str, _Segment] = {}
        self._threads: dict[str, threading.Thread] = {}
        self._opened: list[tuple[str, Any]] = []
        self._lock = threading.Lock()
        self._error: TactflowError | None = None
        self._end: str | None = None
        self._frames = 0
        self._began = 0.0
        self._source_stats = NodeStats()
        self._stopping = threading.Event()
        self._interrupted = False
        self._source: Any = None

    # -- life cycle ---------------------------------------------------------------------------------------

    def run(
        self, on_progress: Callable[[Progress], None] | None = None, interval_s: float = 0.1
    ) -> RunResult:
        """Open everything, run to the end of the source, close everything.

        on_progress : called in this thread about every `interval_s` seconds. Never raises a TactflowError;
        it is in the result. A KeyboardInterrupt raised in this thread ends the run at once.
        """
        self._began = time.perf_counter()
        try:
            self._open()
            self._connect()
            for name, segment in self._segments.items():
                target = self._capture_loop if name == self._source_segment else segment.loop
                thread = threading.Thread(target=target, name=f"tactflow-{name}", daemon=True)
                self._threads[name] = thread
            for thread in self._threads.values():
                thread.start()
            self._wait(on_progress, interval_s)
        except TactflowError as failure:
            self.fail(failure)
        except KeyboardInterrupt:
            self._interrupted = True
            self.stop("signal")
            for link in self._links:
                link.abort()
        finally:
            self._close()
        stats = self._stats(time.perf_counter() - self._began)
        error = self._error
        if self._interrupted:
            return RunResult(INTERRUPTED, None, stats)
        return RunResult(error.exit_code if error else 0, str(error) if error else None, stats)

    def stop(self, reason: str = "signal") -> None:
        """End the run soon: no more frames are captured, those under way are finished. From any thread."""
        with self._lock:
            self._end = self._end or reason
        self._stopping.set()
        if self._source is not None and hasattr(self._source, "stop"):
            self._source.stop()

    def fail(self, error: TactflowError, cause: BaseException | None = None) -> None:
        """Record the error that ends the run (the first one counts) and stop capturing."""
        if cause is not None:
            logger.debug("%s", "".join(traceback.format_exception(cause)))
        with self._lock:
            if self._error is None:
                self._error = error
                self._end = f"error: {str(error).splitlines()[0]}"
        self.stop(f"error: {error}")

    def retake_reference(self) -> None:
        """Take the next frames as a new reference. From any thread."""
        if self._source is not None and hasattr(self._source, "retake"):
            self._source.retake()

    @property
    def source(self) -> Any:
        """The instance of the source stage, once opened."""
        return self._source

    def progress(self) -> Progress:
        """How far the run is."""
        return Progress(self._frames, self._dropped(), time.perf_counter() - self._began)

    def _open(self) -> None:
        """Build and open the source first, then stages, then sinks: a missing recording truncates no file."""
        pipeline = self.pipeline
        if pipeline.opencv_threads is not None:
            import cv2

            cv2.setNumThreads(pipeline.opencv_threads)
        self._source = self._build(pipeline.source, SourceError)
        live = bool(getattr(self._source, "live", False))
        self.plan = make_plan(pipeline, live=live)
        pruned = {node.id for node in self.plan.pruned}
        for node in pipeline.nodes.values():
            if node.component.kind == "source" or node.id in pruned:
                continue
            instance = self._build(node, StageError)
            self.nodes[node.id] = RunningNode(node, instance, skipping=pipeline.skipping, check=self.check)

    def _build(self, node: Node, kind: type[TactflowError]) -> Any:
        """Construct a node's class with what its constructor asks for, and open it."""
        offered = {"sensor": self.pipeline.sensor, "directory": self.pipeline.directory}
        try:
            wanted = inspect.signature(node.component.cls).parameters
            extra = {name: value for name, value in offered.items() if name in wanted}
            instance = node.component.cls(node.params, **extra)
            self._opened.append((node.id, instance))
            if hasattr(instance, "open"):
                instance.open()
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
        return instance

    def _connect(self) -> None:
        self._segments = {name: _Segment(name, self) for name in self.plan.segments}
        for link_plan in self.plan.links:
            link: Link[RunningTick] = Link(link_plan.name, link_plan.capacity, link_plan.when_full)
            self._links.append(link)
            consumer = self._segments[link_plan.consumer]
            consumer.inputs.append(link)
            only_sinks = None
            if all(node.is_sink for node in consumer.nodes):
                only_sinks = frozenset(node.id for node in consumer.nodes)
            self._segments[link_plan.producer].outputs.append((link, only_sinks))

    @property
    def _source_segment(self) -> str:
        return self.plan.segment_of(self.pipeline.source.id)

    def _wait(self, on_progress: Callable[[Progress], None] | None, interval_s: float) -> None:
        """Wait for the threads; after the source has ended, not for ever."""
        deadline: float | None = None
        while alive := [name for name, thread in self._threads.items() if thread.is_alive()]:
            self._threads[alive[0]].join(interval_s)
            if on_progress is not None:
                on_progress(self.progress())
            if self._stopping.is_set() and deadline is None:
                deadline = time.perf_counter() + CLOSE_SECONDS
            if deadline is not None and time.perf_counter() > deadline and self._no_headway():
                hanging = ", ".join(
                    f"{name} (in {self._segments[name].current or 'its source'})" for name in alive
                )
                for link in self._links:
                    link.abort()
                raise StageError(
                    f"the run was stopped, but did not end in {CLOSE_SECONDS:g} s: {hanging} hangs"
                )

    def _no_headway(self) -> bool:
        """Whether no link has delivered anything for a moment: draining a long queue is not hanging."""
        before = [link.stats().delivered for link in self._links]
        time.sleep(0.5)
        return before == [link.stats().delivered for link in self._links]

    def _close(self) -> None:
        """Close whatever was opened, last opened first; every one gets its turn."""
        for node_id, instance in reversed(self._opened):
            try:
                if hasattr(instance, "close"):
                    instance.close()
            except Exception as error:
                self.fail(StageError(f"{node_id}: closing failed: {error}"), error)
        self._opened.clear()

    # -- the source's thread ------------------------------------------------------------------------------

    def _capture_loop(self) -> None:
        segment = self._segments[self._source_segment]
        node = self.pipeline.source
        key = (node.id, node.component.ports.outputs[0].name)
        sinks = [n for n in self.nodes.values() if n.is_sink]
        index = 0
        try:
            frames = iter(self._source.frames())
            while not self._stopping.is_set():
                segment.current = node.id
                began = time.perf_counter()
                try:
                    frame = next(frames, None)
                finally:
                    segment.current = None
                if frame is None:
                    break
                self._source_stats.runs += 1
                self._source_stats.durations.add(time.perf_counter() - began)
                if frame.seq >= 0:
                    self._frames += 1
                tick = RunningTick(index, frame, self._demand(sinks, frame))
                tick.values[key] = frame
                index += 1
                segment.execute(tick)
                segment.forward(tick)
                if self.max_frames is not None and self._frames >= self.max_frames:
                    self.stop("max_frames")
        except _NodeFailedError:
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

    def _demand(self, sinks: Sequence[RunningNode], frame: Frame) -> frozenset[str]:
        """The sinks that want this frame; none wants a reference image that is not part of the source."""
        if frame.seq < 0:
            return frozenset()
        return frozenset(
            sink.id
            for sink in sinks
            if not sink.disabled
            and sink.due(frame)
            and (not hasattr(sink.instance, "wants") or sink.instance.wants())
        )

    # -- statistics ---------------------------------------------------------------------------------------

    def _dropped(self) -> int:
        source = self._segments.get(self._source_segment) if self._segments else None
        if source is None:
            return 0
        return max(
            (link.stats().drops for link, only_sinks in source.outputs if only_sinks is None), default=0
        )

    def _stats(self, wall_s: float) -> dict[str, Any]:
        stages: dict[str, Any] = {self.pipeline.source.id: _node_stats(self._source_stats)}
        sinks: dict[str, Any] = {}
        signals: dict[str, Any] = {}
        for node in self.nodes.values():
            entry = _node_stats(node.stats)
            if node.is_sink:
                if hasattr(node.instance, "counters"):
                    entry["counters"] = dict(node.instance.counters())
                sinks[node.id] = entry
            else:
                stages[node.id] = entry
            signals.update({f"{key[0]}.{key[1]}": dict(signal) for key, signal in node.signals.items()})
        links = {}
        for link in self._links:
            s = link.stats()
            links[link.name] = {
                "policy": s.policy,
                "capacity": s.capacity,
                "high_water": s.high_water,
                "drops": s.drops,
                "blocked_s": round(s.blocked_s, 6),
                "offered": s.offered,
                "delivered": s.delivered,
            }
        dropped = self._dropped()
        return {
            "frames": self._frames - dropped,
            "dropped": dropped,
            "wall_s": round(wall_s, 6),
            "end": self._end or "eos",
            "stages": stages,
            "sinks": sinks,
            "signals": signals,
            "links": links,
            "latency_ms": {"p50": self.latency.milliseconds(0.5), "p99": self.latency.milliseconds(0.99)},
        }


def _node_stats(stats: NodeStats) -> dict[str, Any]:
    return {
        "runs": stats.runs,
        "skips": dict(stats.skips),
        "errors": stats.errors,
        "p50_ms": stats.durations.milliseconds(0.5),
        "p99_ms": stats.durations.milliseconds(0.99),
    }
