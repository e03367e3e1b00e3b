"""Division of a pipeline into segments, connected by links.

The stages of a segment call each other directly, in one thread; segments are connected by a `Link`. By
default: capture | compute | each threaded sink. The pipeline file may assign nodes to other segments.

Every link passes the whole tick, so that a segment needs links only from its direct predecessors (the
transitive reduction of the segment graph). So a live source drops frames in a single place, before the first
segment after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from tactflow.engine.graph import FullPolicy, Mark, Node, Pipeline, Queue

CAPTURE = "capture"
COMPUTE = "compute"
Demand = frozenset[str] | None
"""Ids of the sinks that need a node; None if every tick needs it."""
BLOCK_CAPACITY_FRAMES = 4
"""Length of the queue before a segment of stages, frames; evens out varying durations. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """A link between two segments.

    Attributes
    ----------
    capacity : number of ticks.
    when_full : policy.
    """

    producer: str
    consumer: str
    capacity: int
    when_full: FullPolicy

    @property
    def name(self) -> str:
        """The id in statistics and graphs."""
        return f"{self.producer}->{self.consumer}"


@dataclass(frozen=True, slots=True)
class Plan:
    """How to run a pipeline.

    Attributes
    ----------
    segments : name -> node ids in order of evaluation; the source's segment is the first.
    links : between segments.
    pruned : stages that are not constructed, because no sink needs them.
    """

    pipeline: Pipeline
    segments: Mapping[str, Sequence[str]]
    links: Sequence[LinkPlan]
    pruned: Sequence[Node]

    def segment_of(self, node_id: str) -> str:
        """The segment of a node."""
        return next(name for name, nodes in self.segments.items() if node_id in nodes)

    def roots(self, segment: str) -> dict[str, Demand]:
        """The roots of a segment: sinks, nodes that need every tick, and inputs of other segments.

        Gates in other segments are assumed to be open: too much may be computed, never too little.
        """
        demand: dict[str, Demand] = dict.fromkeys(self.pipeline.nodes, frozenset())
        roots: dict[str, Demand] = {}
        # In reverse topological order, all users of a node come before it.
        for node in reversed(list(self.pipeline.nodes.values())):
            if node in self.pruned:
                continue
            own: Demand = frozenset({node.id} if node.component.kind == "sink" else ())
            own = None if remembers(node, self.pipeline) else own
            demand[node.id] = need = _union(demand[node.id], own)
            is_inside = node.id in self.segments[segment]
            if is_inside and own != frozenset():
                roots[node.id] = need
            for maker in dependencies(node):
                demand[maker] = _union(demand[maker], need)
                if maker in self.segments[segment] and not is_inside:
                    roots[maker] = _union(roots.get(maker, frozenset()), need)
        return {id_: roots[id_] for id_ in self.segments[segment] if id_ in roots}

    @property
    def idle(self) -> list[Node]:
        """Stages that no sink needs, perhaps by mistake; without those that run only for a sink."""
        return [node for node in self.pruned if not node.component.cls.on_demand]

    @property
    def warnings(self) -> list[str]:
        """Warnings for the user, before the run."""
        return [f"{node.mark}  {node.id}: not run, because no sink needs its output" for node in self.idle]


def dependencies(node: Node) -> set[str]:
    """Ids of the nodes whose outputs a node uses, as inputs or as gates."""
    return {ref.node for ref in node.inputs.values() if ref} | {gate.signal.node for gate in node.gates}


def remembers(node: Node, pipeline: Pipeline) -> bool:
    """Whether a node needs every tick: it is stateful, or has a gate that repeats its last outputs."""
    repeats = pipeline.skipping and any(gate.otherwise == "repeat" for gate in node.gates)
    return node.component.memory == "stateful" or repeats


def _union(first: Demand, second: Demand) -> Demand:
    return None if first is None or second is None else first | second


def make_plan(pipeline: Pipeline, *, live: bool = False) -> Plan:
    """Prune unneeded stages, divide the rest into segments, and choose the links between them.

    pipeline : without a `plan_problem`. live : whether frames are dropped rather than delayed.
    """
    pruned, members, before = _cut(pipeline)
    links: list[LinkPlan] = []
    for consumer, producers in before.items():
        direct = producers - {a for producer in producers for a in _ancestors(producer, before)}
        links.extend(
            _link(pipeline, producer, consumer, members, live=live)
            for producer in sorted(direct, key=list(members).index)
        )
    return Plan(pipeline, members, links, pruned)


def plan_problem(pipeline: Pipeline) -> tuple[Mark, str] | None:
    """The error that prevents a plan, with the location of its cause."""
    _, members, before = _cut(pipeline)
    return _cycle(pipeline, members, before) or _idle_queue(pipeline, members)


def _cycle(
    pipeline: Pipeline, members: Mapping[str, Sequence[str]], before: Mapping[str, Iterable[str]]
) -> tuple[Mark, str] | None:
    """Segments that form a cycle."""
    cycle = [name for name in before if name in _ancestors(name, before)]
    placed = [pipeline.nodes[id_] for name in cycle for id_ in members[name] if pipeline.nodes[id_].segment]
    if not placed:
        return None
    contents = " and ".join(f"{name} ({', '.join(members[name])})" for name in cycle)
    return (
        placed[0].mark,
        f"{placed[0].id}: the segments {contents} form a cycle, so none could start; move a stage to another",
    )


def _idle_queue(pipeline: Pipeline, members: Mapping[str, Sequence[str]]) -> tuple[Mark, str] | None:
    """A queue setting without effect."""
    for ids in members.values():
        queued = [node for node in map(pipeline.nodes.__getitem__, ids) if node.queue != Queue()]
        for node in queued:
            if node.component.kind == "source":
                return node.mark, f"{node.id}.queue: nothing comes before the source"
            if node is not queued[0]:
                taken = f"its segment has a queue already, that of {queued[0].id} ({queued[0].mark})"
                return node.mark, f"{node.id}.queue: {taken}; a segment has one queue in front of it"
    return None


def _cut(pipeline: Pipeline) -> tuple[list[Node], dict[str, list[str]], dict[str, set[str]]]:
    """Pruned nodes; segment -> its nodes, the source's first; segment -> segments of its inputs."""
    source = pipeline.source
    needed = {source.id, *(sink.id for sink in pipeline.sinks)}
    # In reverse topological order.
    for node in reversed(list(pipeline.nodes.values())):
        if node.id in needed:
            needed |= dependencies(node)
    first = source.segment or CAPTURE
    names = {source.id: first}
    members = {first: [source.id]}
    before: dict[str, set[str]] = {first: set()}
    for node in pipeline.nodes.values():
        if node.id in needed and node is not source:
            inputs = {names[id_] for id_ in dependencies(node)} or {first}
            name = node.segment or _segment_for(node, inputs, first, before)
            names[node.id] = name
            members.setdefault(name, []).append(node.id)
            before.setdefault(name, set()).update(inputs - {name})
    return [node for node in pipeline.nodes.values() if node.id not in needed], members, before


def _segment_for(node: Node, inputs: set[str], first: str, before: Mapping[str, set[str]]) -> str:
    """The segment of a node without one in the file.

    It is the last segment of its inputs, so that two segments never wait for each other; if its inputs come
    from parallel segments, one of its own.

    inputs : segments of its inputs. first : segment of the source.
    """
    if node.component.delivery.threaded:
        return node.id
    last = {name for name in inputs if not any(name in _ancestors(input_, before) for input_ in inputs)}
    if last == {first}:
        return COMPUTE
    return last.pop() if len(last) == 1 else node.id


def _ancestors(name: str, before: Mapping[str, Iterable[str]]) -> set[str]:
    ancestors: set[str] = set()
    pending = list(before[name])
    while pending:
        ancestor = pending.pop()
        if ancestor not in ancestors:
            ancestors.add(ancestor)
            pending.extend(before[ancestor])
    return ancestors


def _link(
    pipeline: Pipeline, producer: str, consumer: str, members: Mapping[str, Sequence[str]], *, live: bool
) -> LinkPlan:
    nodes = [pipeline.nodes[id_] for id_ in members[consumer]]
    queue = next((node.queue for node in nodes if node.queue != Queue()), Queue())
    sinks = [node.component.delivery for node in nodes if node.component.kind == "sink"]
    if len(sinks) == len(nodes):
        capacity = max(delivery.queue_capacity for delivery in sinks)
        newest = all(delivery.when_live == "latest" for delivery in sinks)
    else:
        capacity = max([BLOCK_CAPACITY_FRAMES, *(delivery.queue_capacity for delivery in sinks)])
        newest = pipeline.source.id in members[producer]
    policy: FullPolicy = "latest" if live and newest else "block"
    return LinkPlan(producer, consumer, queue.capacity or capacity, queue.when_full or policy)
