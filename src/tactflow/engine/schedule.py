"""What each segment evaluates, in which order, and when: a flat list per segment, made with the plan.

A value is computed only when somebody asks for it in this tick: a sink that wants the frame, or a stage that
must see every frame because it remembers. Who asks may stand behind gates. So every node of the list has
*needs*: it is evaluated when one of them holds. A node's own gates are looked at when it is evaluated.

The makers of gate signals come first in the list, each after what it needs itself. A gate therefore is known
before what only its stage needs. Where that is not possible (the signal is made later, or in another thread),
the gate is taken for open: too much may then be computed, never too little.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from tactflow.engine.graph import Node, Pipeline, Ref
from tactflow.engine.plan import Plan, dependencies


@dataclass(frozen=True, slots=True)
class Need:
    """A reason to evaluate a node.

    sinks : one of them wants the tick; None: every tick. signals : all of them are True.
    """

    sinks: frozenset[str] | None
    signals: frozenset[Ref]

    def covers(self, other: Need) -> bool:
        """Whether this one holds whenever the other does."""
        fewer_signals = self.signals <= other.signals
        return fewer_signals and (
            self.sinks is None or (other.sinks is not None and other.sinks <= self.sinks)
        )


@dataclass(frozen=True, slots=True)
class Step:
    """A node and its needs."""

    node: Node
    needs: Sequence[Need]


Schedule = Mapping[str, Sequence[Step]]
"""Segment -> its steps, in order of evaluation; the source is not among them."""


def make_schedule(plan: Plan) -> Schedule:
    """Order the nodes of a plan and find out when each of them is needed."""
    pipeline = plan.pipeline
    order = _order(plan)
    place = {node.id: number for number, node in enumerate(order)}
    segments = {node.id: plan.segment_of(node.id) for node in order}
    needs: dict[str, list[Need]] = {node.id: _own_needs(node, pipeline) for node in order}

    def known(signal: Ref, user: Node) -> bool:
        """Whether a signal is there when it is decided whether a node is needed."""
        if signal.node == pipeline.source.id:
            return True
        mine, its = segments[user.id], segments[signal.node]
        return its in plan.ancestors[mine] or (its == mine and place[signal.node] < place[user.id])

    for consumer in reversed(order):
        gates = gate_signals(consumer, pipeline)
        for maker in dependencies(consumer):
            if maker not in place:
                continue
            # A gate is looked at whenever its stage is needed; the inputs only if the gates are open.
            passed = gates if maker not in {signal.node for signal in gates} else frozenset[Ref]()
            node = pipeline.nodes[maker]
            for need in needs[consumer.id]:
                signals = frozenset(s for s in need.signals | passed if known(s, node))
                needs[maker].append(Need(need.sinks, signals))
    steps: dict[str, list[Step]] = {name: [] for name in plan.segments}
    for node in order:
        steps[segments[node.id]].append(Step(node, _merged(needs[node.id])))
    return steps


def remembers(node: Node, pipeline: Pipeline) -> bool:
    """Whether a node must see every tick: it has memory, or a gate that repeats its last outputs."""
    repeats = pipeline.skipping and any(gate.otherwise == "repeat" for gate in node.gates)
    return node.component.memory == "stateful" or repeats


def gate_signals(node: Node, pipeline: Pipeline) -> frozenset[Ref]:
    """The signals that must be True for a node to run; none where skipping is off."""
    return frozenset(gate.signal for gate in node.gates) if pipeline.skipping else frozenset()


def _own_needs(node: Node, pipeline: Pipeline) -> list[Need]:
    if node.component.kind == "sink":
        return [Need(frozenset({node.id}), frozenset())]
    return [Need(None, frozenset())] if remembers(node, pipeline) else []


def _order(plan: Plan) -> list[Node]:
    """Every node after what it takes from; makers of gate signals first, then who remembers, then sinks."""
    pipeline = plan.pipeline
    pruned = {node.id for node in plan.pruned}
    nodes = [n for n in pipeline.nodes.values() if n.id not in pruned and n.component.kind != "source"]
    makers = {signal.node for node in nodes for signal in gate_signals(node, pipeline)}
    first = [node for node in nodes if node.id in makers]
    then = [node for node in nodes if remembers(node, pipeline)]
    done: dict[str, Node] = {}

    def visit(node: Node) -> None:
        if node.id in done or node.component.kind == "source":
            return
        for ref in [*gate_signals_in_order(node), *(ref for ref in node.inputs.values() if ref)]:
            visit(pipeline.nodes[ref.node])
        done[node.id] = node

    for node in [*first, *then, *nodes]:
        visit(node)
    return list(done.values())


def gate_signals_in_order(node: Node) -> list[Ref]:
    """The signals of a node's gates, as they stand in the file."""
    return [gate.signal for gate in node.gates]


def _merged(needs: Iterable[Need]) -> list[Need]:
    """The same in fewer needs: those with the same signals together, none that another covers."""
    sinks: dict[frozenset[Ref], frozenset[str] | None] = {}
    for need in needs:
        before = sinks.get(need.signals, frozenset())
        sinks[need.signals] = None if before is None or need.sinks is None else before | need.sinks
    merged = [Need(who, signals) for signals, who in sinks.items()]
    return [need for need in merged if not any(o is not need and o.covers(need) for o in merged)]
