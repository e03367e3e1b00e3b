"""`tactflow graph`: a pipeline as a Mermaid flowchart."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from tactflow.cli.options import add_pipeline, load_plan
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.plan import Plan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `graph`."""
    add_pipeline(parser)


def run(args: argparse.Namespace) -> int:
    """Print the flowchart."""
    pipeline, plan = load_plan(args)
    print("\n".join(mermaid(pipeline, plan)))
    return 0


def mermaid(pipeline: Pipeline, plan: Plan) -> Iterator[str]:
    """Lines of a flowchart: segments as boxes, the queues between them as thick arrows, gates dotted.

    Stages that no sink needs stand outside, with a dashed outline.
    """
    names = {id_: f"n{index}" for index, id_ in enumerate(pipeline.nodes)}
    boxes = {segment: f"s{index}" for index, segment in enumerate(plan.segments)}
    yield "flowchart LR"
    for segment, members in plan.segments.items():
        yield f'  subgraph {boxes[segment]}["segment {segment}"]'
        for id_ in members:
            yield f"    {names[id_]}{_shape(pipeline.nodes[id_])}"
        yield "  end"
    for node in plan.pruned:
        yield f"  {names[node.id]}{_shape(node)}:::pruned"
    for node in pipeline.nodes.values():
        takes: dict[str, list[str]] = {}
        for ref in node.inputs.values():
            if ref is not None and ref.port not in takes.setdefault(ref.node, []):
                takes[ref.node].append(ref.port)
        for giver, ports in takes.items():
            yield f'  {names[giver]} -->|"{", ".join(ports)}"| {names[node.id]}'
        for gate in node.gates:
            yield f'  {names[gate.signal.node]} -.->|"when {gate.signal.port}"| {names[node.id]}'
    for link in plan.links:
        queue = f"{link.when_full}, {link.capacity}"
        yield f'  {boxes[link.producer]} ==>|"queue: {queue}"| {boxes[link.consumer]}'
    if plan.pruned:
        yield "  classDef pruned stroke-dasharray: 4"


def _shape(node: Node) -> str:
    left, right = {"source": ("([", "])"), "stage": ("[", "]"), "sink": ("[/", "/]")}[node.component.kind]
    return f'{left}"{node.id}"{right}'
