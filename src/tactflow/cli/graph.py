"""`tactflow graph`: a pipeline as a Mermaid flowchart."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from typing import Any

from tactflow.cli.node_summary import NodeSummary, milliseconds, share
from tactflow.cli.options import add_pipeline_and_stats, load_with_stats
from tactflow.cli.printable import printable
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.plan import Plan

_COSTLY = 0.1
"""Part of all the time, from which a stage is drawn as a costly one. Chosen by hand."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `graph`."""
    add_pipeline_and_stats(parser)


def run(args: argparse.Namespace) -> int:
    """Print the flowchart."""
    print(printable("\n".join(mermaid(*load_with_stats(args)))))
    return 0


def mermaid(pipeline: Pipeline, plan: Plan, statistics: Mapping[str, Any] | None = None) -> Iterator[str]:
    """Lines of a flowchart: segments as boxes, the queues between them as thick arrows, gates dotted.

    Stages that no sink needs stand outside, with a dashed outline. statistics : content of a statistics file;
    nodes then tell how often they ran, why not and how long a run took, and those that took more than a tenth
    of the time after the source are filled.
    """
    told = {} if statistics is None else {**statistics.get("sinks", {}), **statistics["stages"]}
    summaries = {id_: NodeSummary.of(entry) for id_, entry in told.items() if id_ in pipeline.nodes}
    spent = {id_: summary.spent_ms for id_, summary in summaries.items() if id_ != pipeline.source.id}
    costly = [id_ for id_, time in spent.items() if time > _COSTLY * sum(spent.values())]
    names = {id_: f"n{index}" for index, id_ in enumerate(pipeline.nodes)}
    boxes = {segment: f"s{index}" for index, segment in enumerate(plan.segments)}
    yield "flowchart LR"
    for segment, members in plan.segments.items():
        yield f'  subgraph {boxes[segment]}["segment {segment}"]'
        for id_ in members:
            yield f"    {names[id_]}{_shape(pipeline.nodes[id_], summaries.get(id_))}"
        yield "  end"
    for node in plan.pruned:
        yield f"  {names[node.id]}{_shape(node, None)}:::pruned"
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
    if costly:
        yield "  classDef costly fill:#fdd0a2,stroke:#d94801,color:#000"
        yield f"  class {','.join(names[id_] for id_ in costly)} costly"


def _shape(node: Node, summary: NodeSummary | None) -> str:
    left, right = {"source": ("([", "])"), "stage": ("[", "]"), "sink": ("[/", "/]")}[node.component.kind]
    lines = [node.id]
    if summary is not None and node.component.kind == "sink":
        lines.append(f"{summary.runs} times")
    elif summary is not None and summary.ticks:
        lines += [f"ran {share(summary.runs, summary.ticks)}", *summary.reasons()]
    if summary is not None and summary.mean_ms is not None:
        lines.insert(1, milliseconds(summary.mean_ms))
    # A quotation mark would end the label, and < begin a tag.
    label = "<br/>".join(line.replace('"', "'").replace("<", "&lt;") for line in lines)
    return f'{left}"{label}"{right}'
