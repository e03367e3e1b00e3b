"""A sink that passes every result of a run to a function."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.frame import Tick
from tactflow.engine.graph import Component, Delivery, Mark, Node, Pipeline, Ref
from tactflow.engine.ports import Port, Ports, ResultParameter, ports_of

T = TypeVar("T", bound=Tick)


class Collect(Sink):
    """Calls a function with every result."""

    class Params(StageParams):
        """The function `take`, called with each result in the thread that computes it."""

        take: Callable[[Any], None]

    params: Params

    def write(self, result: Tick) -> None:
        """Pass the result on."""
        self.params.take(result)


def with_collector(
    pipeline: Pipeline,
    kind: type[T],
    take: Callable[[T], None],
    *,
    name: str,
    sinks: bool = False,
    background: bool = False,
    references: bool = False,
) -> Pipeline:
    """Add a sink that passes every result to a function.

    A result holds the outputs of all stages except those that run only for a sink (`on_demand`). The sink
    requests the ports that `kind` names and those that no other stage reads. The others are included if they
    were computed anyway, so that collecting does not force work that the pipeline skips.

    Parameters
    ----------
    pipeline : loaded. kind : class of the results. take : called with each of them, in order.
    name : id of the sink; a dot in it keeps it distinct from the ids of pipeline files.
    sinks : keep the pipeline's own sinks.
    background : call `take` in its own thread, where it may block.
    references : also collect a reference image that is not part of the source.
    """
    nodes = {id_: node for id_, node in pipeline.nodes.items() if sinks or node.component.kind != "sink"}
    known = {port.name for port in ports_of(kind)}
    stages = [node for node in pipeline.nodes.values() if node.component.kind == "stage"]
    stages = [node for node in stages if not node.component.cls.on_demand]
    outputs = _named_outputs(stages)
    read = {ref for node in stages for ref in [*node.inputs.values(), *(gate.signal for gate in node.gates)]}
    inputs = {port: ref for port, ref in outputs.items() if port in known or ref not in read}
    passive = {port: ref for port, ref in outputs.items() if port not in inputs}
    # Accept any value: the stage that returns it checks it.
    ports = Ports([Port(port, object, True) for port in inputs], (), ResultParameter(len(inputs), kind))
    delivery = Delivery(
        threaded=background, when_live="latest" if background else "block", takes_references=references
    )
    component = Component(name, "sink", Collect, Collect.Params, ports, "pure", "tactflow", Collect, delivery)
    nodes[name] = Node(
        name, component, Collect.Params(take=take), inputs, Mark(name, 0, 0), passive_inputs=passive
    )
    return replace(pipeline, nodes=nodes)


def _named_outputs(stages: Sequence[Node]) -> dict[str, Ref]:
    """Name in a result -> output. If several stages have the port, its plain name refers to the last one."""
    refs = [Ref(node.id, port.name) for node in stages for port in node.component.ports.outputs]
    plain = {ref.port: ref for ref in refs}
    count = Counter(ref.port for ref in refs)
    return {str(ref): ref for ref in refs if count[ref.port] > 1} | plain
