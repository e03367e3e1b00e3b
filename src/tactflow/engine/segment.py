"""The nodes of a segment, evaluated in one thread for one tick after another.

Values are computed on demand. The roots are sinks that want the frame and stateful stages, which must process
every frame; evaluating a root pulls what it needs, each node once per tick. The signals of a node's gates are
pulled first, its inputs only if the gates are open, so that a closed gate spares all work before it.
"""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

from tactflow.engine.conformance import METHODS
from tactflow.engine.contract import Stage
from tactflow.engine.ending import Ending
from tactflow.engine.errors import StageError, TactflowError
from tactflow.engine.frame import Absent, Frame
from tactflow.engine.graph import Node
from tactflow.engine.link import Link
from tactflow.engine.node import DAMAGED, RunningNode, TickState
from tactflow.engine.plan import Plan, remembers
from tactflow.engine.stats import Durations

logger = logging.getLogger("tactflow")

_DISABLED = Absent("disabled")
_ERROR = Absent("error")


class NodeFailedError(Exception):
    """Ends a segment after a fatal error of one of its nodes."""


class NewReferences:
    """Turns requested frames into references, before the first segment of stages.

    Parameters
    ----------
    slot : of the source's frames.
    sinks : ids of those that take every reference.
    """

    def __init__(self, slot: int, sinks: Collection[str]) -> None:
        self._slot = slot
        self._sinks = frozenset(sinks)
        self._reason: str | None = None
        self._taken = 0
        self._epoch = 0

    def ask(self, reason: str) -> None:
        """Request the next frame as a reference."""
        self._reason = reason

    def enter(self, tick: TickState) -> None:
        """Set the epoch of a tick's frame, and turn it into a reference if requested."""
        frame = tick.frame
        # A damaged frame cannot be a reference; the next one can.
        reason, self._reason = (None, self._reason) if frame.damaged else (self._reason, None)
        if reason is not None and frame.epoch == self._epoch:
            self._taken += 1
            tick.renewed = reason
            tick.demand |= self._sinks
        self._epoch = frame.epoch
        if self._taken:
            reference = frame.reference or tick.renewed is not None
            tick.frame = replace(frame, reference=reference, epoch=frame.epoch + self._taken)
            if not frame.damaged:
                tick.values[self._slot] = tick.frame


class Segment:
    """Evaluates the nodes of one segment for a tick.

    Parameters
    ----------
    name : in the plan.
    nodes : all open ones of the run.
    ending : of the run.
    retake : asks the source for a new reference.

    Attributes
    ----------
    inputs, outputs : links; an output with the ids of the sinks that it leads to, or None if it also leads
        to stages.
    nodes : in order of evaluation.
    current : id of the running node.
    calls : number of calls of nodes so far.
    latency : from capture to the end of its data sinks.
    epoch : of the last tick; a new one resets all nodes.
    references : turns frames into references on request of its stages; None if other stages may have
        processed those frames already.
    """

    def __init__(
        self,
        name: str,
        plan: Plan,
        nodes: Mapping[str, RunningNode],
        ending: Ending,
        retake: Callable[[], None],
    ) -> None:
        self.name = name
        self._ending = ending
        self.latency = Durations()
        self._retake = retake
        self.nodes = [nodes[id_] for id_ in plan.segments[name] if id_ in nodes]
        by_id = {node.id: node for node in self.nodes}
        for node in self.nodes:
            node.makers = _existing(by_id, [ref.node for ref in node.node.inputs.values() if ref])
            if node.gates:
                node.signal_makers = _existing(by_id, [gate.signal.node for gate in node.node.gates])
        self._remembering = [
            node for node in self.nodes if node.sink is None and remembers(node.node, plan.pipeline)
        ]
        roots = plan.roots(name)
        self._roots = [(by_id[id_], sinks) for id_, sinks in roots.items() if id_ in by_id]
        self._watchers = [
            (node.stage, maker, slot)
            for node in self.nodes
            if node.stage is not None
            for maker, slot in _last_with(node.stage.watches, nodes.values())
        ]
        self._data_sinks = [n for n in self.nodes if n.sink and not n.node.component.delivery.observer]
        self.inputs: list[Link[TickState]] = []
        self.outputs: list[tuple[Link[TickState], frozenset[str] | None]] = []
        self.epoch = 0
        self.references: NewReferences | None = None
        self.current: str | None = None
        self.calls = 0

    @property
    def only_sinks(self) -> bool:
        """Whether it has no stages."""
        return all(node.sink is not None for node in self.nodes)

    def handle(self, tick: TickState) -> None:
        """Compute this segment's part of a tick, and pass the tick on."""
        self._execute(tick)
        self._forward(tick)

    def _execute(self, tick: TickState) -> None:
        """Evaluate the roots of this segment."""
        if self.references is not None:
            self.references.enter(tick)
        if tick.frame.epoch != self.epoch:
            self.epoch = tick.frame.epoch
            for node in self.nodes:
                node.reset()
        if tick.frame.damaged:
            self._hold(tick)
        for node, sinks in self._roots:
            if node.pulled != tick.index and (sinks is None or not sinks.isdisjoint(tick.demand)):
                self._pull(node, tick)
        for node in self.nodes:
            if node.pulled != tick.index:
                node.stats.skips["no_demand"] += 1
        for stage, maker, slot in self._watchers:
            # The value of another segment may be of another frame.
            stage.watched = maker not in self.nodes or tick.values[slot] is not False
        self.current = None
        if tick.demand and self._data_sinks:
            self.latency.add(perf_counter() - tick.frame.captured)

    def _hold(self, tick: TickState) -> None:
        """Repeat the outputs of all stages with a memory, for a damaged frame. The others get the same inputs
        as before, and so give the same outputs."""
        for node in self._remembering:
            if not node.disabled:
                node.pulled = tick.index
                node.skip(tick, DAMAGED, repeat=True)

    def _pull(self, node: RunningNode, tick: TickState) -> None:
        """Evaluate a node and what it needs, unless a gate, an absent or unchanged inputs make it skip."""
        index = node.pulled = tick.index
        if node.gates:
            for maker in node.signal_makers:
                if maker.pulled != index:
                    self._pull(maker, tick)
            closed = node.closed_gate(tick.values)
            if closed is not None:
                gate, slot, absent = closed
                repeat = gate.otherwise == "repeat"
                if not repeat:
                    # Earlier outputs must not be repeated after absent ones.
                    node.forget()
                signal = tick.values[slot]
                absent = signal if isinstance(signal, Absent) else absent
                node.skip(tick, DAMAGED if tick.frame.damaged else absent, repeat=repeat)
                return
        if node.disabled:
            node.skip(tick, _DISABLED)
            return
        for maker in node.makers:
            if maker.pulled != index:
                self._pull(maker, tick)
        inputs = node.inputs(tick)
        if isinstance(inputs, Absent):
            node.skip(tick, inputs)
        elif node.is_unchanged(inputs):
            assert node.last is not None
            node.stats.skips["unchanged"] += 1
            node.publish(tick, node.last)
        else:
            self._run(node, tick, inputs)

    def _run(self, node: RunningNode, tick: TickState, inputs: Sequence[Any]) -> None:
        self.current = node.id
        self.calls += 1
        began = perf_counter()
        try:
            outputs = node(inputs, tick)
        except Exception as error:
            self._failed(node, tick, inputs, error)
            return
        node.stats.durations.add(perf_counter() - began)
        node.publish(tick, outputs)
        if node.stage is not None and node.stage.wants_reference is not None:
            self._renew(node.stage, node.id, tick.frame)

    def _renew(self, stage: Stage, name: str, frame: Frame) -> None:
        """Take a new reference, on request of a stage."""
        reason, stage.wants_reference = stage.wants_reference, None
        assert reason is not None
        logger.info("frame %d: %s takes a new reference: %s", frame.seq, name, reason.replace("_", " "))
        if self.references is not None:
            self.references.ask(reason)
        else:
            self._retake()

    def _failed(self, node: RunningNode, tick: TickState, inputs: Sequence[Any], error: Exception) -> None:
        node.stats.errors += 1
        policy = node.node.on_error
        failure = _failure(node.node, tick.frame, inputs, error)
        if policy.action == "disable":
            node.disabled = True
            logger.warning("%s\n  %s is disabled for the rest of the run", failure, node.id)
            node.skip(tick, _DISABLED)
        elif policy.action == "skip_frame" and node.stats.errors <= policy.budget:
            logger.warning("%s\n  frame skipped (%d of %d)", failure, node.stats.errors, policy.budget)
            node.skip(tick, _ERROR)
        else:
            if policy.action == "skip_frame":
                failure = StageError(
                    f"{failure}\n  (the budget of {policy.budget} skipped frames is used up)"
                )
            self._ending.fail(failure, error)
            raise NodeFailedError

    def _forward(self, tick: TickState) -> None:
        """Pass the tick to the next segments; to those with sinks only, if one of them wants it."""
        for link, only_sinks in self.outputs:
            if only_sinks is None or not only_sinks.isdisjoint(tick.demand):
                link.put(tick, keep=tick.frame.reference)

    def _next_tick(self) -> TickState | None:
        """The next tick that all input links provide; None at the end of the stream."""
        if len(self.inputs) == 1:
            return self.inputs[0].get()
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
            while (tick := self._next_tick()) is not None:
                self.handle(tick)
        except NodeFailedError:
            pass
        except BaseException as error:
            self._ending.fail(StageError(f"segment {self.name}: {type(error).__name__}: {error}"), error)
        finally:
            for link in self.inputs:
                link.abort()
            for link, _ in self.outputs:
                link.close()


def _existing(nodes: Mapping[str, RunningNode], ids: Sequence[str]) -> list[RunningNode]:
    """The nodes with these ids, if they exist, each once."""
    return [nodes[id_] for id_ in dict.fromkeys(ids) if id_ in nodes]


def _last_with(port: str | None, nodes: Iterable[RunningNode]) -> list[tuple[RunningNode, int]]:
    """The last node that has a signal, and the slot of it; an empty list if there is none."""
    if port is None:
        return []
    return [(node, node.signals[port][0]) for node in nodes if port in node.signals][-1:]


def _failure(node: Node, frame: Frame, values: Sequence[Any], error: Exception) -> StageError:
    """Describe which node failed in which frame, where in its code, and with which inputs.

    values : of its inputs, in the order of its ports.
    """
    if isinstance(error, TactflowError):
        return StageError(f"{node.id}, frame {frame.seq} ({node.mark}): {error}")
    engine = os.path.dirname(__file__)
    entries = traceback.extract_tb(error.__traceback__)
    # The calls of the engine come first, then the code of the node.
    own = next((entry for entry in entries if os.path.dirname(entry.filename) != engine), None)
    if own is None:
        # The engine rejected the returned value.
        code = getattr(node.component.cls, METHODS[node.component.kind]).__code__
        where = f"{code.co_filename}:{code.co_firstlineno}"
    else:
        where = f"{own.filename}:{own.lineno}"
        if entries[-1] is not own:
            where += f" (raised at {entries[-1].filename}:{entries[-1].lineno})"
    ports = node.component.ports.inputs
    inputs = [f"{port.name}: {_describe(value)}" for port, value in zip(ports, values, strict=True)]
    return StageError(
        f"{node.id} failed at frame {frame.seq}: {type(error).__name__}: {error}\n"
        f"  in {where}\n  set up at {node.mark}\n  inputs: {', '.join(inputs) or 'none'}"
    )


def _describe(value: Any) -> str:
    """Shape and dtype of an array, else the type's name."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{tuple(value.shape)} {value.dtype}"
    return "absent" if value is None else type(value).__name__
