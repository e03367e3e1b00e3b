"""A stage or sink at run time: its instance, inputs and statistics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import is_, itemgetter
from typing import Any

from tactflow.engine.conformance import METHODS
from tactflow.engine.contract import Part, Sink, Stage
from tactflow.engine.frame import Absent, Frame, Tick, read_only
from tactflow.engine.graph import Gate, Node
from tactflow.engine.ports import SignalPort, check_values, port_type
from tactflow.engine.rate import RateLimit
from tactflow.engine.stats import NodeStats, SignalStats

Slots = Mapping[tuple[str, str], int]
"""(node id, port name) of every output -> its slot in a tick's table of values, from 1."""

UNCONNECTED = 0
"""The slot that always holds None, for unconnected optional inputs."""

DAMAGED = Absent("damaged")
"""The value of the source's frame if it is damaged and none came before."""

_NONE = Absent("none")
_NO_DEMAND = Absent("no_demand")


class TickState:
    """The values of one frame, which each segment fills in for its own nodes.

    Parameters
    ----------
    index : number of the tick in this run.
    demand : ids of the sinks that want it.

    Attributes
    ----------
    values : one per slot; `Absent` if missing.
    reasons : slot -> why its value was not computed in this tick, for absent and repeated values.
    renewed : the reason if a stage requested this frame as a reference, else None.
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


class RunningNode:
    """A stage or sink at run time, used by the thread of its segment.

    Parameters
    ----------
    skipping : whether gates may close and results be reused.
    check : whether to check values against their port types.

    Attributes
    ----------
    instance : of the class; `sink` or `stage` is the same object, the other is None.
    slots : of its outputs.
    gates : each with the slot of its signal, and the value of its outputs while it is closed.
    signals : boolean output port -> (slot, counts of true values).
    presences : the same for outputs that may be absent, counting the present values.
    makers, signal_makers : nodes of the same segment that produce its inputs and the signals of its gates.
    pulled : index of the last tick in which it was evaluated.
    disabled : whether it failed and is not called any more.
    last : the outputs of its last run, for repeating gates and repeated inputs.
    """

    def __init__(self, node: Node, instance: Part, slots: Slots, *, skipping: bool, check: bool) -> None:
        self.node = node
        self.id = node.id
        self.instance = instance
        self.sink = instance if isinstance(instance, Sink) else None
        self.stage = instance if isinstance(instance, Stage) else None
        ports = node.component.ports
        self._ports = ports
        refs = {port.name: node.inputs.get(port.name) for port in ports.inputs}
        input_slots = [slots[ref.node, ref.port] if ref else UNCONNECTED for ref in refs.values()]
        self._connected_slots = [slot for slot in input_slots if slot != UNCONNECTED]
        self._take: Callable[[Sequence[Any]], Sequence[Any]] = _getter(input_slots)
        shown = {**node.passive_inputs, **refs}
        self._shown = [(name, slots[ref.node, ref.port]) for name, ref in shown.items() if ref]
        self.slots = [slots[node.id, port.name] for port in ports.outputs]
        gates = node.gates if skipping else ()
        self.gates = [
            (gate, slots[gate.signal.node, gate.signal.port], Absent(gate.reason)) for gate in gates
        ]
        self.signals: dict[str, tuple[int, SignalStats]] = {}
        self.presences: dict[str, tuple[int, SignalStats]] = {}
        for slot, port in zip(self.slots, ports.outputs, strict=True):
            if isinstance(port_type(port.annotation), SignalPort):
                self.signals[port.name] = slot, SignalStats()
            elif port.optional:
                self.presences[port.name] = slot, SignalStats()
        self._counted = [(*counted, True) for counted in self.signals.values()]
        self._counted += [(*counted, False) for counted in self.presences.values()]
        self.makers: list[RunningNode] = []
        self.signal_makers: list[RunningNode] = []
        self.pulled = -1
        self.disabled = False
        self.rate_limit = RateLimit(node.max_rate)
        self.stats = NodeStats()
        self._check = check
        self._function: Callable[..., Any] = getattr(instance, METHODS[node.component.kind])
        self._is_pure = (
            skipping
            and node.component.memory == "pure"
            and self.sink is None
            and all(gate.otherwise == "absent" for gate, *_ in self.gates)
        )
        self.last: Sequence[Any] | None = None
        self._last_inputs: Sequence[Any] | None = None

    def reset(self) -> None:
        """Clear the state before a new reference."""
        self.forget()
        if self.stage is not None:
            self.stage.wants_reference = None
            self.stage.reset()

    def forget(self) -> None:
        """Discard the last outputs, so that they are not repeated."""
        self.last = self._last_inputs = None

    def closed_gate(self, table: Sequence[Any]) -> tuple[Gate, int, Absent] | None:
        """The closed gate that decides about the outputs in this tick, as in `gates`, or None.

        A gate that makes the outputs absent takes precedence over one that repeats them.
        """
        closed: tuple[Gate, int, Absent] | None = None
        for found in self.gates:
            if table[found[1]] is not True:
                if found[0].otherwise == "absent":
                    return found
                closed = closed or found
        return closed

    def inputs(self, tick: TickState) -> Sequence[Any] | Absent:
        """Its inputs, None for absent optional ones; or the `Absent` of a required input."""
        values = list(self._take(tick.values))
        if self.sink is not None and tick.frame.damaged:
            values = [tick.frame if isinstance(value, Frame) else value for value in values]
        # For each input of each node: comparing types costs less than a loop with `isinstance`.
        if Absent in map(type, values):
            for number, value in enumerate(values):
                if value.__class__ is Absent:
                    if not self._ports.inputs[number].optional:
                        return value
                    values[number] = None
        return values

    def is_unchanged(self, inputs: Sequence[Any]) -> bool:
        """Whether its last outputs are still valid: it is pure, and had the same inputs."""
        return self._last_inputs is not None and all(map(is_, inputs, self._last_inputs))

    def __call__(self, inputs: Sequence[Any], tick: TickState) -> Sequence[Any]:
        """Run it. Returns one value per output port, `Absent` if missing."""
        arguments = [read_only(value) for value in inputs] if self._check else inputs
        if (result := self._ports.result) is not None:
            arguments = [self._tick(result.kind, tick), *arguments[result.count :]]
        outputs = _outputs(self._function(*arguments), len(self.slots))
        if self._check:
            check_values(self._ports, inputs, outputs)
        self.last = outputs
        if self._is_pure:
            self._last_inputs = inputs
        return outputs

    def _tick(self, kind: type[Tick], tick: TickState) -> Tick:
        """The result for a sink: its inputs, and the reasons for those that were not computed."""
        table, reasons = tick.values, tick.reasons
        values = {name: table[slot] for name, slot in self._shown}
        skipped = {name: reasons[slot] for name, slot in self._shown if slot in reasons}
        if tick.renewed is not None:
            skipped["reference"] = tick.renewed
        if self._check:
            values = {name: read_only(value) for name, value in values.items()}
        return kind(tick.frame, values, skipped)

    def publish(self, tick: TickState, outputs: Sequence[Any]) -> None:
        """Enter its outputs into the tick's table."""
        values, reasons, damaged = tick.values, tick.reasons, tick.frame.damaged
        inherited = self._inherited_reason(reasons) if reasons and (self._is_pure or damaged) else None
        for slot, value in zip(self.slots, outputs, strict=True):
            values[slot] = value
            if value.__class__ is Absent and not (damaged and inherited):
                reasons[slot] = value.reason
            elif inherited is not None:
                reasons[slot] = inherited
        if self._counted:
            self._count(values)

    def _inherited_reason(self, reasons: Mapping[int, str]) -> str | None:
        """Why its outputs are repeated: the reason of the first input, if all connected inputs have one.

        This depends on the data alone, not on earlier runs of the node, so that an observer changes no
        reasons either.
        """
        for slot in self._connected_slots:
            if slot not in reasons:
                return None
        return reasons[self._connected_slots[0]] if self._connected_slots else None

    def skip(self, tick: TickState, absent: Absent, *, repeat: bool = False) -> None:
        """Enter its outputs without running it: `absent`, or with `repeat` the last ones."""
        self.stats.skips[absent.reason] += 1
        last = self.last if repeat else None
        for number, slot in enumerate(self.slots):
            tick.values[slot] = absent if last is None else last[number]
            tick.reasons[slot] = absent.reason
        if self._counted:
            self._count(tick.values)

    def _count(self, values: list[Any]) -> None:
        for slot, stats, is_signal in self._counted:
            value = values[slot]
            is_true = value.__class__ is not Absent
            if is_signal and is_true:
                # Gates compare with Python's True, which NumPy's is not.
                values[slot] = is_true = bool(value)
            stats.add(is_true)


def _getter(slots: Sequence[int]) -> Callable[[Sequence[Any]], Sequence[Any]]:
    """A function that takes the values of these slots out of a table."""
    if len(slots) > 1:
        return itemgetter(*slots)
    return lambda table: [table[slot] for slot in slots]


def _outputs(result: Any, count: int) -> Sequence[Any]:
    """The return value of a node as one value per output port; None stands for absent."""
    values: Sequence[Any]
    if isinstance(result, tuple):
        values = result
        for value in result:
            if value is None:
                values = [_NONE if value is None else value for value in result]
                break
    elif result is None or isinstance(result, Absent):
        values = [_NONE if result is None else result] * count
    else:
        values = [result] if count else []
    if len(values) != count:
        raise TypeError(f"required {count} outputs, got {len(values)}")
    return values
