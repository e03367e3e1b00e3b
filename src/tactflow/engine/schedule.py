"""What each segment evaluates, in which order, and when: a flat list per segment, made with the plan.

A value is computed only when somebody asks for it in this tick: a sink that wants the frame, or a stage that
must see every frame because it remembers. Who asks may stand behind gates. So every node of the list has
*needs*: it is evaluated when one of them holds. A node's own gates are looked at when it is evaluated.

The makers of gate signals come first in the list, each after what it needs itself. A gate therefore is known
before what only its stage needs. Where that is not possible (the signal is made later, or in another thread),
the gate is taken for open: too much may then be computed, never too little. A stage that runs for such a
reason may also fail.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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
    nodes = _in_order(plan, {})
    # First as if every signal were known in time: who is guarded by which signals, and so better comes later.
    ideal = _needs(nodes, pipeline, lambda *_: True)
    order = _in_order(plan, {id_: _guards(needs) for id_, needs in ideal.items()})
    place = {node.id: number for number, node in enumerate(order)}
    segments = {node.id: plan.segment_of(node.id) for node in order}

    def known(signal: Ref, user: Node) -> bool:
        """Whether a signal is there when it is decided whether a node is needed."""
        if signal.node == pipeline.source.id:
            return True
        mine, its = segments[user.id], segments[signal.node]
        return its in plan.ancestors[mine] or (its == mine and place[signal.node] < place[user.id])

    needs = _needs(order, pipeline, known)
    steps: dict[str, list[Step]] = {name: [] for name in plan.segments}
    for node in order:
        steps[segments[node.id]].append(Step(node, _merged(needs[node.id])))
    return steps


def _needs(
    order: Sequence[Node], pipeline: Pipeline, known: Callable[[Ref, Node], bool]
) -> dict[str, list[Need]]:
    """Node -> its needs: its own, and those of all that take from it.

    Say `gated` has `when: active`, which `pulse` makes, and the sink `out` takes from `gated`. Then what
    `gated` reads is needed when `out` wants the frame and `active` is True; `pulse` whenever `out` wants it.
    """
    needs = {node.id: _own_needs(node, pipeline) for node in order}
    for consumer in reversed(order):
        gates = gate_signals(consumer, pipeline)
        for maker in dependencies(consumer) & needs.keys():
            # A gate is looked at whenever its stage is needed; the inputs only if the gates are open.
            passed = gates if maker not in {signal.node for signal in gates} else frozenset[Ref]()
            node = pipeline.nodes[maker]
            for need in needs[consumer.id]:
                signals = frozenset(s for s in need.signals | passed if known(s, node))
                needs[maker].append(Need(need.sinks, signals))
    return needs


def _guards(needs: Sequence[Need]) -> frozenset[str]:
    """The makers of the signals without which a node is never needed."""
    common = frozenset.intersection(*(need.signals for need in needs)) if needs else frozenset[Ref]()
    return frozenset(signal.node for signal in common)


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


def _in_order(plan: Plan, guards: Mapping[str, frozenset[str]]) -> list[Node]:
    """Every node after what it takes from and, where possible, after the makers of what guards it.

    Makers of gate signals come first, then who remembers, then the others.
    """
    pipeline = plan.pipeline
    pruned = {node.id for node in plan.pruned}
    nodes = [n for n in pipeline.nodes.values() if n.id not in pruned and n.component.kind != "source"]
    makers = {signal.node for node in nodes for signal in gate_signals(node, pipeline)}
    first = [node for node in nodes if node.id in makers]
    then = [node for node in nodes if remembers(node, pipeline)]
    wanted: dict[str, None] = {}
    under_way: set[str] = set()

    def visit(id_: str) -> None:
        """What guards a node first, then its gates, its inputs, itself."""
        node = pipeline.nodes[id_]
        if id_ in under_way or node.component.kind == "source":
            return
        under_way.add(id_)
        inputs = [ref.node for ref in node.inputs.values() if ref]
        for other in [*sorted(guards.get(id_, ())), *(gate.signal.node for gate in node.gates), *inputs]:
            visit(other)
        wanted[id_] = None

    placed: dict[str, Node] = {}

    def place(id_: str) -> None:
        """A node after what it takes from, which guards that depend on each other may have turned around."""
        node = pipeline.nodes[id_]
        if id_ in placed or node.component.kind == "source":
            return
        for other in dependencies(node):
            place(other)
        placed[id_] = node

    for node in [*first, *then, *nodes]:
        visit(node.id)
    for id_ in wanted:
        place(id_)
    return list(placed.values())


def _merged(needs: Iterable[Need]) -> list[Need]:
    """The same in fewer needs: those with the same signals together, none that another covers."""
    sinks: dict[frozenset[Ref], frozenset[str] | None] = {}
    for need in needs:
        before = sinks.get(need.signals, frozenset())
        sinks[need.signals] = None if before is None or need.sinks is None else before | need.sinks
    merged = [Need(who, signals) for signals, who in sinks.items()]
    return [need for need in merged if not any(o is not need and o.covers(need) for o in merged)]
