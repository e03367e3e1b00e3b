"""What runs in one thread: a segment's nodes, evaluated for one tick after another.

In a segment, values are pulled: only what a sink asks for in this tick, and what a stateful stage must
see, is computed, each node at most once. A gate is looked at before the inputs of its stage, so a closed
gate never runs what only that stage needs.
"""

from __future__ import annotations

import inspect
import logging
import traceback
from collections.abc import Callable, Mapping, Sequence
from operator import is_, itemgetter
from time import perf_counter
from typing import Any, Protocol

from tactflow.engine.check import ArrayCheck
from tactflow.engine.errors import StageError, TactflowError
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.engine.graph import Gate, Node
from tactflow.engine.link import Link
from tactflow.engine.plan import Plan
from tactflow.engine.ports import Port, SignalPort, port_type
from tactflow.engine.rate import RateLimit
from tactflow.engine.stats import Durations, NodeStats, SignalStats
from tactflow.engine.trace import Track

logger = logging.getLogger("tactflow")

Slots = Mapping[tuple[str, str], int]
"""(node id, port name) of every output -> its place in a tick's table of values, from 1."""

NOTHING = 0
"""The place in that table of what an optional input gets that is connected to nothing: always None."""

_NO_VALUE = (Absent, tuple)
_DISABLED = Absent("disabled")
_ERROR = Absent("error")
_NONE = Absent("none")


class Run(Protocol):
    """What a segment needs to know of the run it belongs to."""

    plan: Plan
    nodes: dict[str, RunningNode]
    latency: Durations

    def fail(self, error: TactflowError, cause: BaseException | None = None) -> None: ...


class RunningTick:
    """One frame's journey: a table of values that segments fill in, each its own part.

    demand : ids of the sinks that want this tick. values : one per slot; None for what nobody has made yet.
    reasons : slot -> why it was not computed in this tick; a slot may have both a reason and a value, when
    its last value was repeated. absent : False as long as no value of the table can be an `Absent`.
    """

    __slots__ = ("absent", "demand", "frame", "index", "reasons", "values")

    def __init__(self, index: int, frame: Frame, demand: frozenset[str], slots: int) -> None:
        self.index = index
        self.frame = frame
        self.demand = demand
        self.values: list[Any] = [None] * slots
        self.reasons: dict[int, str] = {}
        self.absent = False


class _RunningGate:
    """A gate with its memory: frames since it was last open. slot : of its signal."""

    __slots__ = ("absent", "no_memory", "plan", "repeats", "since_open", "since_true", "slot")

    def __init__(self, plan: Gate, slots: Slots) -> None:
        self.plan = plan
        self.slot = slots[plan.signal.node, plan.signal.port]
        self.absent = Absent(plan.reason)
        self.repeats = plan.otherwise == "repeat"
        self.no_memory = not plan.hold and plan.at_least_every is None
        self.since_true: int | None = None
        self.since_open = 0

    def is_open(self, signal: Any) -> bool:
        """Take in this tick's signal. An absent signal closes the gate."""
        true = signal is not None and not isinstance(signal, Absent) and bool(signal)
        if self.no_memory:
            return true
        self.since_true = 0 if true else None if self.since_true is None else self.since_true + 1
        every = self.plan.at_least_every
        held = self.since_true is not None and self.since_true <= self.plan.hold
        due = every is not None and self.since_open + 1 >= every
        self.since_open = 0 if held or due else self.since_open + 1
        return held or due

    def reset(self) -> None:
        self.since_true, self.since_open = None, 0


class RunningNode:
    """A stage or sink at run time: the instance, where its inputs come from, what it has done.

    How it is called is decided here once, not in every frame. pick : takes its arguments from a tick's
    values. slots : of its outputs. single : the only one of them, if it is no signal. positional : its
    function takes just these arguments, in this order; tick_first : the same behind a `Tick`. Else they are
    given by name.
    """

    __slots__ = (
        "check",
        "disabled",
        "function",
        "gates",
        "id",
        "input_slots",
        "inputs",
        "instance",
        "is_sink",
        "last",
        "last_arguments",
        "names",
        "node",
        "pick",
        "positional",
        "rate_limit",
        "remembers",
        "repeats",
        "reuses",
        "signals",
        "single",
        "slots",
        "stateful",
        "stats",
        "takes_references",
        "takes_tick",
        "tick_first",
        "took",
        "wants",
    )

    def __init__(self, node: Node, instance: Any, slots: Slots, *, skipping: bool, check: bool) -> None:
        self.node = node
        self.id = node.id
        self.instance = instance
        component = node.component
        self.is_sink = component.kind == "sink"
        self.function: Callable[..., Any] = getattr(
            instance, "write" if self.is_sink else "process", _no_function
        )
        self.inputs: list[tuple[Port, int]] = []
        for port in component.ports.inputs:
            ref = node.inputs.get(port.name)
            self.inputs.append((port, slots[ref.node, ref.port] if ref else NOTHING))
        self.names = [port.name for port, _ in self.inputs]
        self.pick = _picker([slot for _, slot in self.inputs])
        self.input_slots = [slot for _, slot in self.inputs if slot != NOTHING]
        self.slots = [slots[node.id, port.name] for port in component.ports.outputs]
        self.gates = [_RunningGate(gate, slots) for gate in node.gates] if skipping else []
        self.repeats = any(gate.repeats for gate in self.gates)
        self.stateful = (
            component.memory == "stateful" or self.repeats or any(not gate.no_memory for gate in self.gates)
        )
        self.stats = NodeStats()
        self.took = self.stats.durations.add
        self.signals = {
            port.name: (slot, SignalStats())
            for slot, port in zip(self.slots, component.ports.outputs, strict=True)
            if isinstance(port_type(port.annotation), SignalPort)
        }
        self.single = self.slots[0] if len(self.slots) == 1 and not self.signals else NOTHING
        self.disabled = False
        self.wants: Callable[[], bool] | None = getattr(instance, "wants", None)
        self.takes_references = bool(getattr(instance, "takes_references", False))
        self.takes_tick = any(not parameter.ports for parameter in component.ports.parameters)
        self.reuses = skipping and not self.stateful and not self.is_sink
        self.remembers = self.repeats or self.reuses
        self.last: Sequence[Any] | None = None
        self.last_arguments: Sequence[Any] | None = None
        self.check = ArrayCheck(node) if check else None
        order = _parameters(self.function)
        self.positional = order == self.names and not self.takes_tick and not check
        self.tick_first = order == ["tick", *self.names]
        self.rate_limit = None if node.max_rate is None else RateLimit(node.max_rate)

    def reset(self) -> None:
        """A new reference follows: forget what was learned from the last one."""
        self.last = self.last_arguments = None
        for gate in self.gates:
            gate.reset()
        if hasattr(self.instance, "reset"):
            self.instance.reset()


def _urgent(node: RunningNode) -> bool:
    """Whether somebody waits for what a node makes, rather than only looking on or reading it later."""
    sink = node.instance
    hands_out = getattr(sink, "when_live", "block") == "latest" and not getattr(sink, "observer", False)
    return not node.is_sink or hands_out


def _picker(slots: Sequence[int]) -> Callable[[list[Any]], Sequence[Any]]:
    """What takes the values at these slots out of a table."""
    if len(slots) > 1:
        return itemgetter(*slots)
    # A getter of one index would return the value itself, one of a slice returns a list of it.
    return itemgetter(slice(slots[0], slots[0] + 1) if slots else slice(0))


def _parameters(function: Callable[..., Any]) -> list[str] | None:
    """The names under which a function takes its arguments by position; None where it takes others too.

    What a decorator says about the function inside does not count: arguments are given to the decorator.
    """
    try:
        parameters = inspect.signature(function, follow_wrapped=False).parameters.values()
    except (TypeError, ValueError):
        return None
    if any(parameter.kind is not parameter.POSITIONAL_OR_KEYWORD for parameter in parameters):
        return None
    return [parameter.name for parameter in parameters]


def _no_function(**_: Any) -> None:
    raise AssertionError("a source is not called")


class NodeFailedError(Exception):
    """Ends a segment because one of its nodes failed for good."""


class _Step:
    """A node as one segment sees it, with all that it pulls looked up once.

    own : evaluated here; else it belongs to a later segment and is only walked through, to what it needs from
    here. gates : each with the step that makes its signal (None: made already) and whether it decides here.
    opens : slot of the signal that decides alone, by being True in this very tick; NOTHING if it is not that
    simple. before : steps that make its inputs and may not have been visited. seen : index of the tick in
    which it was visited last.

    Stateful steps are visited first and in the pipeline's order, so whoever takes from one finds it visited.
    """

    __slots__ = ("before", "gates", "node", "opens", "own", "seen")

    def __init__(self, node: RunningNode, own: bool, known: set[str], steps: dict[str, _Step]) -> None:
        self.node = node
        self.own = own
        self.seen = -1
        pulled = {id_: step for id_, step in steps.items() if not step.node.stateful}
        self.gates: list[tuple[_RunningGate, _Step | None, bool]] = []
        for gate in node.gates:
            # The memory of a later segment's gate is not known here: such a gate may be open.
            maker = gate.plan.signal.node
            decides = own or (gate.no_memory and maker in known)
            self.gates.append((gate, pulled.get(maker), decides))
        self.opens = NOTHING
        if len(self.gates) == 1:
            gate, to_pull, _ = self.gates[0]
            self.opens = gate.slot if gate.no_memory and to_pull is None else NOTHING
        makers = dict.fromkeys(ref.node for ref in node.node.inputs.values() if ref)
        self.before = [pulled[maker] for maker in makers if maker in pulled]


class Segment:
    """Evaluates the nodes of one segment for a tick.

    track : where to note what is done when; None for nowhere.

    Attributes
    ----------
    urgent : whether somebody waits for what it does: it captures, computes, or hands the newest results out.
    """

    def __init__(self, name: str, run: Run, track: Track | None = None) -> None:
        self.name = name
        self.run = run
        self.track = track
        plan = run.plan
        self.nodes = [run.nodes[i] for i in plan.segments[name] if i in run.nodes]
        mine = {node.id for node in self.nodes}
        self._slots = {slot: node.id for node in self.nodes for slot in node.slots}
        known = mine | {i for a in plan.ancestors[name] for i in plan.segments[a]}
        # Every input comes before its user in the pipeline, so a step finds those it needs.
        steps: dict[str, _Step] = {}
        for id_ in plan.pipeline.nodes:
            if id_ in run.nodes and (id_ in mine or id_ not in known):
                steps[id_] = _Step(run.nodes[id_], id_ in mine, known, steps)
        self._own = [steps[node.id] for node in self.nodes]
        self._stateful = [step for step in steps.values() if step.node.stateful]
        self._sinks = [step for step in steps.values() if step.node.is_sink]
        self.data_sinks = [n for n in self.nodes if n.is_sink and not getattr(n.instance, "observer", False)]
        self.urgent = plan.pipeline.source.id in plan.segments[name] or any(map(_urgent, self.nodes))
        self.inputs: list[Link[RunningTick]] = []
        self.outputs: list[tuple[Link[RunningTick], frozenset[str] | None]] = []
        self.epoch = 0
        self.current: str | None = None

    def handle(self, tick: RunningTick) -> None:
        """Compute this segment's part of a tick and hand the tick on."""
        track = self.track
        if track is None:
            self.execute(tick)
            self.forward(tick)
            return
        began = perf_counter()
        for link in self.inputs:
            track.arrives((link.name, tick.index), began)
        self.execute(tick)
        self.forward(tick)
        mine = self._slots
        skipped = {mine[slot]: reason for slot, reason in list(tick.reasons.items()) if slot in mine}
        name = f"frame {tick.frame.seq}" if tick.frame.seq >= 0 else "reference image"
        track.add(name, began, perf_counter(), {"seq": tick.frame.seq, "skipped": skipped})

    def execute(self, tick: RunningTick) -> None:
        """Compute what this tick needs from this segment."""
        if tick.frame.epoch != self.epoch:
            self.epoch = tick.frame.epoch
            for node in self.nodes:
                node.reset()
        index = tick.index
        for step in self._stateful:
            if step.seen != index:
                self._visit(step, tick)
        demand = tick.demand
        if demand:
            for step in self._sinks:
                if step.node.id in demand and step.seen != index:
                    self._visit(step, tick)
        self.current = None
        for step in self._own:
            if step.seen != index:
                step.node.stats.skips["no_demand"] += 1
        if demand and self.data_sinks:
            self.run.latency.add(perf_counter() - tick.frame.captured)

    def _visit(self, step: _Step, tick: RunningTick) -> None:
        """Pull one node, once a tick: first its gates, then its inputs, then the node itself.

        Between two stages little of this is left in the processor's caches, so what it costs is the memory it
        touches. What happens in most frames stands here in one piece, the rest elsewhere.
        """
        step.seen = index = tick.index
        table = tick.values
        if step.gates and table[step.opens] is not True and not self._opened(step, tick):
            return
        for maker in step.before:
            if maker.seen != index:
                self._visit(maker, tick)
        if not step.own:
            return
        node = step.node
        arguments = node.pick(table)
        if tick.absent or node.disabled:
            present = self._present(node, tick, arguments)
            if present is None:
                return
            arguments = present
        # A pure stage with the very inputs of its last run would give the very outputs of its last run.
        same = node.last_arguments
        if same is not None and arguments[0] is same[0] and all(map(is_, arguments, same)):
            assert node.last is not None
            node.stats.skips["unchanged"] += 1
            self._publish(node, tick, node.last)
            return
        self.current = node.id
        began = perf_counter()
        try:
            result = node.function(*arguments) if node.positional else self._call(node, tick, arguments)
            plain = node.single and result is not None and not isinstance(result, _NO_VALUE)
            values = (result,) if plain else _values(result, len(node.slots))
            if node.check is not None:
                node.check.outputs(arguments, values)
        except Exception as error:
            self._failed(node, tick, arguments, error)
            return
        ended = perf_counter()
        node.took(ended - began)
        if self.track is not None:
            self.track.add(node.id, began, ended, {"seq": tick.frame.seq})
        if node.remembers:
            node.last = values
            if node.reuses:
                node.last_arguments = arguments
        if plain and not (node.reuses and tick.reasons):
            table[node.single] = result
        else:
            self._publish(node, tick, values)

    def _opened(self, step: _Step, tick: RunningTick) -> bool:
        """Whether the gates of a step are open; if not, its outputs are entered as they are then."""
        closed: Absent | None = None
        repeat = True
        for gate, maker, decides in step.gates:
            if maker is not None and maker.seen != tick.index:
                self._visit(maker, tick)
            if not decides:
                continue
            signal = tick.values[gate.slot]
            if step.own:
                # A gate whose closing means that there is nothing weighs more than one that repeats.
                if not gate.is_open(signal) and (closed is None or (repeat and not gate.repeats)):
                    closed = signal if isinstance(signal, Absent) else gate.absent
                    repeat = gate.repeats
            elif isinstance(signal, Absent) or not signal:
                return False
        if closed is not None:
            node = step.node
            if node.repeats and not repeat:
                # One gate says that there is nothing: what was before that is not repeated after it either.
                node.last = node.last_arguments = None
            self._skip(node, tick, closed, repeat=repeat)
        return closed is None

    def _present(self, node: RunningNode, tick: RunningTick, values: Sequence[Any]) -> Sequence[Any] | None:
        """The arguments of a node, absent ones as None; None if it cannot be called, which is entered."""
        if node.disabled:
            self._skip(node, tick, _DISABLED)
            return None
        arguments = list(values)
        for number, (port, _) in enumerate(node.inputs):
            value = arguments[number]
            if isinstance(value, Absent):
                if not port.optional:
                    self._skip(node, tick, value)
                    return None
                arguments[number] = None
        return arguments

    def _skip(self, node: RunningNode, tick: RunningTick, absent: Absent, *, repeat: bool = False) -> None:
        reason = absent.reason
        node.stats.skips[reason] += 1
        tick.absent = True
        last = node.last if repeat else None
        for number, slot in enumerate(node.slots):
            tick.values[slot] = absent if last is None else last[number]
            tick.reasons[slot] = reason
        if node.signals:
            self._count_signals(node, tick)

    def _call(self, node: RunningNode, tick: RunningTick, arguments: Sequence[Any]) -> Any:
        """Call a function by name or with a `Tick`; under check, with read-only inputs."""
        check = node.check
        given = arguments if check is None else [check.read_only(value) for value in arguments]
        if node.takes_tick:
            told = Tick(tick.frame, self._skipped(node, tick))
            if node.tick_first:
                return node.function(told, *given)
            return node.function(tick=told, **dict(zip(node.names, given, strict=True)))
        return node.function(**dict(zip(node.names, given, strict=True)))

    def _publish(self, node: RunningNode, tick: RunningTick, values: Sequence[Any]) -> None:
        """Enter a node's outputs into the tick's table.

        They carry the reason of its inputs when all of those are repeated ones. This goes by the data alone,
        not by whether the node had run before, so that an observer changes no reason either.
        """
        inherited = None
        if node.reuses and tick.reasons:
            reasons = [tick.reasons.get(slot) for slot in node.input_slots]
            if reasons and None not in reasons:
                inherited = reasons[0]
        table = tick.values
        for slot, value in zip(node.slots, values, strict=True):
            table[slot] = value
            if isinstance(value, Absent):
                tick.absent = True
                tick.reasons[slot] = value.reason
            elif inherited is not None:
                tick.reasons[slot] = inherited
        if node.signals:
            self._count_signals(node, tick)

    def _count_signals(self, node: RunningNode, tick: RunningTick) -> None:
        for slot, signal in node.signals.values():
            value = tick.values[slot]
            signal.add(not isinstance(value, Absent) and bool(value))

    def _skipped(self, node: RunningNode, tick: RunningTick) -> dict[str, str]:
        reasons = tick.reasons
        if not reasons:
            return {}
        return {port.name: reasons[slot] for port, slot in node.inputs if slot in reasons}

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
            self.run.fail(failure)
            raise NodeFailedError
        if policy.action == "disable":
            node.disabled = True
            logger.warning("%s\n  %s is disabled for the rest of the run", failure, node.id)
            self._skip(node, tick, _DISABLED)
        else:
            logger.warning("%s\n  frame skipped (%d of %d)", failure, node.stats.errors, policy.budget)
            self._skip(node, tick, _ERROR)

    def forward(self, tick: RunningTick) -> None:
        """Hand the tick to the next segments. One that holds only sinks gets it only if one of them asked."""
        keep = tick.frame.reference
        for link, only_sinks in self.outputs:
            if only_sinks is None or not only_sinks.isdisjoint(tick.demand):
                if self.track is not None:
                    self.track.leaves((link.name, tick.index))
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
                self.handle(tick)
        except NodeFailedError:
            for link in self.inputs:
                link.abort()
        except BaseException as error:
            self.run.fail(StageError(f"segment {self.name}: {type(error).__name__}: {error}"), error)
            for link in self.inputs:
                link.abort()
        finally:
            for link, _ in self.outputs:
                link.close()


def _values(result: Any, count: int) -> Sequence[Any]:
    """What a node returned, as one value per output port; None stands for absent."""
    if isinstance(result, Absent) or (result is None and count):
        return [result or _NONE] * count
    values: Sequence[Any] = result if isinstance(result, tuple) else [result] if count else ()
    if len(values) != count:
        raise TypeError(f"required {count} outputs, got {len(values)}")
    for value in values:
        if value is None:
            return [_NONE if value is None else value for value in values]
    return values


def describe_failure(node: Node, frame: Frame, arguments: Sequence[Any], error: Exception) -> StageError:
    """An error that says which node failed on which frame, where in its code, and with what inputs."""
    if isinstance(error, TactflowError):
        return StageError(f"{node.id}, frame {frame.seq} ({node.mark}): {error}")
    place = traceback.extract_tb(error.__traceback__)
    # The first entries are the engine's own calls; after them comes the node's own code.
    code = next((entry for entry in place if entry.filename != __file__), place[-1])
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
