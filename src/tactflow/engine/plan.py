"""From a pipeline to segments and links.

Stages of one segment call each other directly in one thread; between segments stands a `Link`. By default:
capture | compute | each threaded sink. Any node may be given a segment of its own in the pipeline file.

Every link hands over the whole tick, so a segment needs links only from the segments directly before it
(the transitive reduction of the segment graph): whatever lies further up is in the tick already. That
also leaves a single place where a live source drops frames: in front of the first segment after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from tactflow.engine.contract import Sink
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import FullPolicy, Mark, Node, Pipeline

CAPTURE = "capture"
COMPUTE = "compute"
BLOCK_CAPACITY = 4
"""Frames that may wait in front of a segment of stages: enough to even out uneven ones. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """A link to be made: from one segment, the producer, to another, the consumer.

    capacity : ticks that it holds. when_full : what happens to one more.
    """

    producer: str
    consumer: str
    capacity: int
    when_full: FullPolicy

    @property
    def name(self) -> str:
        """The link's id in statistics and pictures."""
        return f"{self.producer}->{self.consumer}"


@dataclass(frozen=True, slots=True)
class Plan:
    """How a pipeline is run.

    segments : name -> node ids in order of evaluation; the source's segment comes first.
    links : between segments. pruned : stages that are not built because no sink needs them.
    """

    pipeline: Pipeline
    segments: Mapping[str, Sequence[str]]
    links: Sequence[LinkPlan]
    pruned: Sequence[Node]

    def segment_of(self, node_id: str) -> str:
        """The segment that runs a node."""
        return next(name for name, nodes in self.segments.items() if node_id in nodes)

    @property
    def idle(self) -> list[Node]:
        """Stages that no sink needs, without those that wait for a sink: perhaps a mistake."""
        return [node for node in self.pruned if not getattr(node.component.cls, "on_demand", False)]

    @property
    def warnings(self) -> list[str]:
        """What the user should know before the run."""
        return [f"{node.mark}  {node.id}: not run, because no sink needs what it makes" for node in self.idle]


def dependencies(node: Node) -> set[str]:
    """Ids of the nodes whose outputs a node reads, as inputs or as gates."""
    return {ref.node for ref in node.inputs.values() if ref} | {gate.signal.node for gate in node.gates}


def remembers(node: Node, pipeline: Pipeline) -> bool:
    """Whether a node must see every tick: it has memory, or a gate that repeats its last outputs."""
    repeats = pipeline.skipping and any(gate.otherwise == "repeat" for gate in node.gates)
    return node.component.memory == "stateful" or repeats


def demand(pipeline: Pipeline) -> dict[str, frozenset[str] | None]:
    """Node -> the sinks that need it; None where it is needed in every tick, for a stage that remembers."""
    needs: dict[str, frozenset[str] | None] = {}
    # Every input comes before its user, so that going backwards all users of a node are known.
    for id_, node in reversed(list(pipeline.nodes.items())):
        own = frozenset({id_}) if node.component.kind == "sink" else frozenset[str]()
        before = needs.get(id_, frozenset())
        need = None if before is None or remembers(node, pipeline) else before | own
        needs[id_] = need
        for maker in dependencies(node):
            so_far = needs.get(maker, frozenset[str]())
            needs[maker] = None if so_far is None or need is None else so_far | need
    return needs


def make_plan(pipeline: Pipeline, *, live: bool = False) -> Plan:
    """Prune what no sink needs, cut the rest into segments, and choose the links between them.

    live : the source does not wait; its frames are dropped rather than delayed.

    Raises
    ------
    ConfigError
        If the segments named in the file depend on each other in a circle, or a queue is given to a node
        that shares its segment with the node before it.
    """
    problems = plan_problems(pipeline)
    if problems:
        raise ConfigError("\n".join(f"{mark}  {message}" for mark, message in problems))
    pruned, names, members, before = _cut(pipeline)
    source = names[pipeline.source.id]
    links: list[LinkPlan] = []
    for consumer, producers in before.items():
        direct = producers - {a for producer in producers for a in _ancestors(producer, before)}
        links.extend(
            _link(pipeline, producer, consumer, members[consumer], source, live=live)
            for producer in sorted(direct, key=list(members).index)
        )
    return Plan(pipeline, members, links, pruned)


def plan_problems(pipeline: Pipeline) -> list[tuple[Mark, str]]:
    """What keeps a pipeline from being planned: every mistake, at the place that is to be changed."""
    _, _, members, before = _cut(pipeline)
    return [*_circles(pipeline, before, members), *_idle_queues(pipeline, members)]


def _cut(
    pipeline: Pipeline,
) -> tuple[list[Node], dict[str, str], dict[str, list[str]], dict[str, set[str]]]:
    """Pruned nodes; node -> its segment; segment -> its nodes; segment -> those directly or not before it."""
    needed = {pipeline.source.id, *(sink.id for sink in pipeline.sinks)}
    # Every input comes before its user.
    for node in reversed(list(pipeline.nodes.values())):
        if node.id in needed:
            needed |= dependencies(node)
    pruned = [node for node in pipeline.nodes.values() if node.id not in needed]
    nodes = [node for node in pipeline.nodes.values() if node.id in needed]
    names = _segment_names(nodes)
    source = names[pipeline.source.id]
    members: dict[str, list[str]] = {source: []}
    for node in nodes:
        members.setdefault(names[node.id], []).append(node.id)
    before: dict[str, set[str]] = {name: set() for name in members}
    for node in nodes:
        mine = names[node.id]
        before[mine] |= {names[other] for other in dependencies(node)} - {mine}
        if mine != source and not dependencies(node):
            before[mine].add(source)
    return pruned, names, members, before


def _segment_names(nodes: Sequence[Node]) -> dict[str, str]:
    """The segment of each node, given in order of evaluation.

    A node that names none is run by the segment that its inputs reach last, so that it never makes two
    segments wait for each other; where its inputs come from segments side by side, it gets its own.
    """
    names: dict[str, str] = {}
    before: dict[str, set[str]] = {}
    sources = {node.segment or CAPTURE for node in nodes if node.component.kind == "source"}
    for node in nodes:
        inputs = {names[other] for other in dependencies(node) if other in names}
        earlier = inputs | {a for name in inputs for a in _ancestors(name, before)}
        last = {name for name in inputs if not any(name in _ancestors(other, before) for other in inputs)}
        if node.segment:
            name = node.segment
        elif node.component.kind == "source":
            name = CAPTURE
        elif issubclass(node.component.cls, Sink) and node.component.cls.threaded:
            name = node.id
        elif last <= sources:
            name = COMPUTE
        else:
            name = last.pop() if len(last) == 1 else node.id
        names[node.id] = name
        before.setdefault(name, set()).update(earlier - {name})
    return names


def _ancestors(name: str, before: Mapping[str, Iterable[str]]) -> set[str]:
    ancestors: set[str] = set()
    pending = list(before[name])
    while pending:
        ancestor = pending.pop()
        if ancestor not in ancestors:
            ancestors.add(ancestor)
            pending.extend(before[ancestor])
    return ancestors


def _circles(
    pipeline: Pipeline, before: Mapping[str, set[str]], members: Mapping[str, list[str]]
) -> Iterator[tuple[Mark, str]]:
    """Each set of segments that wait for each other, once, at a node that was put into one of them."""
    reported: set[str] = set()
    for name in before:
        if name in reported or name not in _ancestors(name, before):
            continue
        others = [o for o in before if name in _ancestors(o, before) and o in _ancestors(name, before)]
        reported.update(others)
        inside = [pipeline.nodes[id_] for other in others for id_ in members[other]]
        placed = [node for node in inside if node.segment] or inside
        held = "; ".join(f"{other} holds {', '.join(members[other])}" for other in others)
        yield (
            placed[0].marks.get("segment", placed[0].mark),
            f"{placed[0].id}: segments {', '.join(others)} feed each other in a circle, so none could start; "
            f"{held}: move one of them to another segment",
        )


def _link(
    pipeline: Pipeline, producer: str, consumer: str, members: Sequence[str], source: str, *, live: bool
) -> LinkPlan:
    nodes = [pipeline.nodes[node_id] for node_id in members]
    capacity: int | None = None
    policy: FullPolicy | None = None
    for node in nodes:
        capacity = capacity or node.queue.capacity
        policy = policy or node.queue.when_full
    classes = [node.component.cls for node in nodes]
    sinks = [cls for cls in classes if issubclass(cls, Sink)]
    only_sinks = len(sinks) == len(classes)
    if policy is None:
        newest = all(sink.when_live == "latest" for sink in sinks) if only_sinks else producer == source
        policy = "latest" if live and newest else "block"
    if capacity is None:
        capacity = max((sink.queue_capacity for sink in sinks), default=BLOCK_CAPACITY)
        capacity = capacity if only_sinks else max(capacity, BLOCK_CAPACITY)
    return LinkPlan(producer, consumer, capacity, policy)


def _idle_queues(pipeline: Pipeline, members: Mapping[str, Sequence[str]]) -> Iterator[tuple[Mark, str]]:
    for nodes in members.values():
        queued = [n for n in (pipeline.nodes[i] for i in nodes) if n.queue.capacity or n.queue.when_full]
        for node in queued[1:]:
            yield (
                node.marks.get("queue", node.mark),
                f"{node.id}.queue: its segment has a queue already, given at {queued[0].mark} by "
                f"{queued[0].id}; a segment has one queue in front of it",
            )
        for node in queued:
            if node.component.kind == "source":
                yield (
                    node.marks.get("queue", node.mark),
                    f"{node.id}.queue: nothing comes before the source",
                )
