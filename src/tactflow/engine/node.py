"""A stage or sink while it runs: its instance, where its inputs come from, what it has done."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from itertools import islice
from operator import is_
from typing import Any

from tactflow.engine.check import ArrayCheck
from tactflow.engine.conformance import METHODS
from tactflow.engine.contract import Part, Sink, Stage
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.engine.graph import Gate, Node
from tactflow.engine.ports import SignalPort, port_type
from tactflow.engine.rate import RateLimit
from tactflow.engine.stats import NodeStats, SignalStats

Slots = Mapping[tuple[str, str], int]
"""(node id, port name) of every output -> its place in a tick's table of values, from 1."""

UNCONNECTED = 0
"""The place in that table that always holds None, for optional inputs that are connected to nothing."""

_NONE = Absent("none")
_NO_DEMAND = Absent("no_demand")


class TickState:
    """One frame's journey: a table of values that segments fill in, each its own part.

    index : number of the tick in this run. demand : ids of the sinks that want it. values : one per slot;
    `Absent` where there is none. reasons : slot -> why its value was not computed in this tick, for values
    that are absent or repeated. renewed : why a stage had this frame made a reference, None if none had.
    """

    __slots__ = ("demand", "frame", "index", "reasons", "renewed", "values")

    def __init__(self, index: int, frame: Frame, demand: frozenset[str], slots: int) -> None:
        self.index = index
        self.frame = frame
        self.demand = demand
        self.values: list[Any] = [_NO_DEMAND] * slots
        self.values[UNCONNECTED] = None
        self.reasons: dict[int, str] = {}
        self.renewed: str | None = None


class RunningGate:
    """A gate with its signal looked up.

    slot : of the signal. absent : what the outputs are while it is closed, unless it `repeats`: then they are
    the last ones again.
    """

    __slots__ = ("absent", "repeats", "slot")

    def __init__(self, gate: Gate, slots: Slots) -> None:
        self.slot = slots[gate.signal.node, gate.signal.port]
        self.absent = Absent(gate.reason)
        self.repeats = gate.otherwise == "repeat"


class RunningNode:
    """A stage or sink at run time. Used by the one thread of its segment.

    skipping : whether gates may close and results be reused. check : whether values are checked against the
    port types.

    Attributes
    ----------
    instance : of the class; `sink` or `stage` is the same, the other is None. ports, input_slots : its
    inputs, and where their values are. slots : where its outputs go. signals : output port -> (slot, how
    often it was true), for those that are signals. disabled : it failed and is not called again. check :
    None without checks. last : the outputs of its last run, for gates that repeat them and for inputs that
    come again.
    """

    def __init__(self, node: Node, instance: Part, slots: Slots, *, skipping: bool, check: bool) -> None:
        self.node = node
        self.id = node.id
        self.instance = instance
        self.sink = instance if isinstance(instance, Sink) else None
        self.stage = instance if isinstance(instance, Stage) else None
        ports = node.component.ports
        self.ports = ports.inputs
        refs = [node.inputs.get(port.name) for port in self.ports]
        self.input_slots = [slots[ref.node, ref.port] if ref else UNCONNECTED for ref in refs]
        self._connected_slots = [slot for slot in self.input_slots if slot != UNCONNECTED]
        shown = {**node.passive_inputs, **{name: ref for name, ref in node.inputs.items() if ref}}
        self._shown = [(name, slots[ref.node, ref.port]) for name, ref in shown.items()]
        self.slots = [slots[node.id, port.name] for port in ports.outputs]
        self.gates = [RunningGate(gate, slots) for gate in node.gates] if skipping else []
        self.signals = {
            port.name: (slot, SignalStats())
            for slot, port in zip(self.slots, ports.outputs, strict=True)
            if isinstance(port_type(port.annotation), SignalPort)
        }
        self.disabled = False
        self.rate_limit = RateLimit(node.max_rate)
        self.stats = NodeStats()
        self.check = ArrayCheck(node) if check else None
        function = getattr(instance, METHODS[node.component.kind])
        self._function = _by_position(function, [parameter.name for parameter in ports.parameters])
        self._parameters = ports.parameters
        self._one_port_each = all(p.group is None for p in ports.parameters)
        repeats = any(gate.repeats for gate in self.gates)
        self._is_pure = skipping and node.component.memory == "pure" and self.sink is None and not repeats
        self.last: Sequence[Any] | None = None
        self._last_inputs: Sequence[Any] | None = None

    def reset(self) -> None:
        """A new reference follows: forget what was learned from the last one."""
        self.forget()
        if self.stage is not None:
            self.stage.wants_reference = None
            self.stage.reset()

    def forget(self) -> None:
        """Repeat nothing from before."""
        self.last = self._last_inputs = None

    def closed_gate(self, table: Sequence[Any]) -> RunningGate | None:
        """The gate that keeps it from running in this tick, or None.

        Of several, one that says that there is nothing counts before one that repeats.
        """
        closed: RunningGate | None = None
        for gate in self.gates:
            if table[gate.slot] is not True and (closed is None or (closed.repeats and not gate.repeats)):
                closed = gate
        return closed

    def inputs(self, tick: TickState) -> Sequence[Any] | Absent:
        """Its inputs, None for optional ones that are absent; the `Absent` of a required one."""
        table = tick.values
        values = [table[slot] for slot in self.input_slots]
        if tick.reasons:
            for number, value in enumerate(values):
                if isinstance(value, Absent):
                    if not self.ports[number].optional:
                        return value
                    values[number] = None
        return values

    def had(self, inputs: Sequence[Any]) -> bool:
        """Whether it would give its last outputs again: it is pure, and had these very inputs then."""
        return self._last_inputs is not None and all(map(is_, inputs, self._last_inputs))

    def __call__(self, inputs: Sequence[Any], tick: TickState) -> Sequence[Any]:
        """Run it; one value per output port, `Absent` where there is none."""
        check = self.check
        given = inputs if check is None else [check.read_only(value) for value in inputs]
        arguments = given if self._one_port_each else self._arguments(given, tick)
        outputs = _outputs(self._function(*arguments), len(self.slots))
        if check is not None:
            check.outputs(inputs, outputs)
        self.last = outputs
        if self._is_pure:
            self._last_inputs = inputs
        return outputs

    def _arguments(self, values: Sequence[Any], tick: TickState) -> Sequence[Any]:
        """One argument for each parameter: a port's value, a group of them, or the tick."""
        arguments: list[Any] = []
        rest = iter(values)
        for parameter in self._parameters:
            if parameter.group is None:
                arguments.append(next(rest))
                continue
            group = list(islice(rest, len(parameter.ports)))
            is_tick = issubclass(parameter.group, Tick)
            arguments.append(self._tick(parameter.group, tick) if is_tick else parameter.group(*group))
        return arguments

    def _tick(self, kind: type[Tick], tick: TickState) -> Tick:
        """What a sink gets of a tick: its inputs, and why some were not computed."""
        table, reasons = tick.values, tick.reasons
        values = {name: table[slot] for name, slot in self._shown}
        skipped = {name: reasons[slot] for name, slot in self._shown if slot in reasons}
        if tick.renewed is not None:
            skipped["reference"] = tick.renewed
        if self.check is not None:
            values = {name: self.check.read_only(value) for name, value in values.items()}
        return kind(tick.frame, values, skipped)

    def inherited_reason(self, tick: TickState) -> str | None:
        """Why its outputs are repeated ones: the reason of its inputs, where all that are connected have one.

        This goes by the data alone, not by whether the node had run before, so that an observer changes no
        reason either.
        """
        reasons, first = tick.reasons, None
        if not self._is_pure:
            return None
        for slot in self._connected_slots:
            if slot not in reasons:
                return None
            first = first or reasons[slot]
        return first

    def publish(self, tick: TickState, outputs: Sequence[Any]) -> None:
        """Enter its outputs into the tick's table."""
        inherited = self.inherited_reason(tick) if tick.reasons else None
        for number, slot in enumerate(self.slots):
            tick.values[slot] = value = outputs[number]
            if isinstance(value, Absent):
                tick.reasons[slot] = value.reason
            elif inherited is not None:
                tick.reasons[slot] = inherited
        if self.signals:
            self._read_signals(tick)

    def skip(self, tick: TickState, absent: Absent, *, repeat: bool = False) -> None:
        """Enter what its outputs are where it does not run: absent, or with `repeat` its last ones again."""
        self.stats.skips[absent.reason] += 1
        last = self.last if repeat else None
        for number, slot in enumerate(self.slots):
            tick.values[slot] = absent if last is None else last[number]
            tick.reasons[slot] = absent.reason
        if self.signals:
            self._read_signals(tick)

    def _read_signals(self, tick: TickState) -> None:
        for slot, signal in self.signals.values():
            value = tick.values[slot]
            if not isinstance(value, Absent):
                # NumPy's True is not Python's, which gates look for.
                tick.values[slot] = value = bool(value)
            signal.add(value is True)


def _outputs(result: Any, count: int) -> Sequence[Any]:
    """What a node returned, as one value per output port; None stands for absent."""
    values: list[Any]
    if isinstance(result, tuple):
        values = [_NONE if value is None else value for value in result]
    elif result is None or isinstance(result, Absent):
        values = [result if isinstance(result, Absent) else _NONE] * count
    else:
        values = [result] if count else []
    if len(values) != count:
        raise TypeError(f"required {count} outputs, got {len(values)}")
    return values


def _by_position(function: Callable[..., Any], names: Sequence[str]) -> Callable[..., Any]:
    """A function that takes by position, in the order of `names`, what another one takes by name.

    That is the function itself, unless a decorator stands around it, which may take names only.
    """
    if not hasattr(function, "__wrapped__"):
        parameters = signature(function).parameters.values()
        if [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD] == list(names):
            return function
    return lambda *values: function(**dict(zip(names, values, strict=True)))
