"""A sink that carries every result of a run into Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.frame import Tick
from tactflow.engine.graph import Component, Mark, Node, Pipeline, Ref
from tactflow.engine.ports import ArrayPort, Port, Ports, ResultParameter, port_type, ports_of

T = TypeVar("T", bound=Tick)


class Collect(Sink):
    """Calls a function with every result."""

    class Params(StageParams):
        """take : called with each result, in the thread that computes it."""

        take: Callable[[Any], None]

    params: Params

    def write(self, result: Tick) -> None:
        """Hand the result over."""
        self.params.take(result)


def with_collector(
    pipeline: Pipeline,
    kind: type[T],
    take: Callable[[T], None],
    *,
    name: str,
    sinks: bool = False,
    background: bool = False,
    pictures: bool = True,
    references: bool = False,
) -> Pipeline:
    """The pipeline with a sink that hands every result to a function.

    A result holds every output of every stage, but for stages that wait for a sink (`on_demand`). Asked for
    are those that `kind` names and those that no other stage reads; the others are in it where they were
    computed anyway, so that collecting does not defeat what the pipeline skips.

    Parameters
    ----------
    pipeline : loaded. kind : class of the results. take : gets each of them, in order.
    name : id of the sink, with a point in it, which no id of a pipeline file has.
    sinks : keep the pipeline's own sinks.
    background : call `take` in a thread of its own, where it may block.
    pictures : also collect outputs that are (H, W, 3) uint8 and that `kind` does not name.
    references : also collect a reference image that is not part of the source.
    """
    nodes = {id_: node for id_, node in pipeline.nodes.items() if sinks or node.component.kind != "sink"}
    known = {port.name for port in ports_of(kind)}
    stages = [node for node in pipeline.nodes.values() if node.component.kind == "stage"]
    stages = [node for node in stages if not node.component.cls.on_demand]
    outputs = {
        name: ref
        for name, (ref, port) in _named_outputs(stages).items()
        if pictures or name in known or not _is_picture(port)
    }
    read = {ref for node in stages for ref in [*node.inputs.values(), *(gate.signal for gate in node.gates)]}
    inputs = {port: ref for port, ref in outputs.items() if port in known or ref not in read}
    passive = {port: ref for port, ref in outputs.items() if port not in inputs}
    # Any value: whether it is what its port promises is checked where it is made.
    ports = Ports([Port(port, object, True) for port in inputs], (), ResultParameter(0, len(inputs), kind))
    policy = {"threaded": True, "when_live": "latest"} if background else {}
    cls: type[Collect] = type("Collect", (Collect,), {"takes_references": references, **policy})
    component = Component(name, "sink", cls, cls.Params, ports, "pure", "tactflow")
    nodes[name] = Node(
        name, component, cls.Params(take=take), inputs, Mark(name, 0, 0), passive_inputs=passive
    )
    return replace(pipeline, nodes=nodes)


def _named_outputs(stages: Sequence[Node]) -> dict[str, tuple[Ref, Port]]:
    """Name in a result -> the output; where several stages give a port, the plain name is the last one's."""
    found: dict[str, list[tuple[Ref, Port]]] = {}
    for node in stages:
        for port in node.component.ports.outputs:
            found.setdefault(port.name, []).append((Ref(node.id, port.name), port))
    several = [output for outputs in found.values() if len(outputs) > 1 for output in outputs]
    return {str(ref): (ref, port) for ref, port in several} | {name: o[-1] for name, o in found.items()}


def _is_picture(port: Port) -> bool:
    spec = port_type(port.annotation)
    return isinstance(spec, ArrayPort) and spec.dtype == "uint8" and spec.shape[2:] == (3,)
