"""`tactflow explain`: why each stage runs, is skipped or pruned, and what it cost; `tactflow graph`: the
pipeline as a Mermaid flowchart."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tactflow.cli.options import add_pipeline, load_plan
from tactflow.cli.progress import END_WORDS
from tactflow.engine.contract import Sink
from tactflow.engine.graph import Gate, Node, Pipeline
from tactflow.engine.plan import Plan, dependencies
from tactflow.engine.stats import read_statistics
from tactflow.system.terminal import show

FAILURE_REASONS = ("error", "disabled")
"""Reasons for not running that are failures, which save no time."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `explain`."""
    add_pipeline(parser)
    parser.add_argument(
        "--stats",
        type=Path,
        metavar="run.json",
        help="statistics of a run (tactflow run --stats), to show how often each stage ran and what it cost",
    )


def run(args: argparse.Namespace) -> int:
    """Print a paragraph for each stage and sink."""
    statistics = None if args.stats is None else read_statistics(args.stats)
    pipeline, plan = load_plan(args)
    skipping = "" if pipeline.skipping else ", skipping is off"
    show([f"{pipeline.file}: sensor {pipeline.sensor}, segments {', '.join(plan.segments)}{skipping}"])
    if statistics is not None:
        show([_whole_run(statistics)])
    for id_, texts in _facts(pipeline, plan, statistics):
        width = max(map(len, texts))
        show(
            ["", f"{id_} ({texts.pop('at')})", *(f"  {k.ljust(width)}  {text}" for k, text in texts.items())]
        )
    return 0


def _whole_run(run: Mapping[str, Any]) -> str:
    times = ((name, run["latency_ms"][name]) for name in ("p50", "p99"))
    latency = ", ".join(f"{name} unknown" if ms is None else f"{name} {ms:.3g} ms" for name, ms in times)
    frames = f"{run['frames']} frames in {run['wall_s']:.1f} s, {run['dropped']} dropped"
    return f"the run: {frames}, latency {latency}, ended: {END_WORDS.get(run['end'], run['end'])}"


def _cost(node: Mapping[str, Any]) -> str:
    """How often a stage ran and why not, time of a run, and what skipping saved per frame."""
    runs = node["runs"]
    frames = runs + sum(node["skips"].values())
    if not frames:
        return "never reached by a frame"
    skips = sorted(((n, reason) for reason, n in node["skips"].items() if n), reverse=True)
    reasons = ", ".join(f"{100 * n / frames:.3g} % {reason.replace('_', ' ')}" for n, reason in skips)
    text = f"ran {100 * runs / frames:.3g} %" + (f", skipped {reasons}" if reasons else "")
    if not runs:
        return text
    mean = node["total_ms"] / runs
    text += f"; a run: mean {mean:.3g} ms, p50 {node['p50_ms']:.3g} ms, p99 {node['p99_ms']:.3g} ms"
    saved = mean * sum(n for n, reason in skips if reason not in FAILURE_REASONS)
    if saved:
        text += f"; saved {saved / frames:.3g} ms of {(saved + node['total_ms']) / frames:.3g} ms a frame"
    return text


def _facts(
    pipeline: Pipeline, plan: Plan, statistics: Mapping[str, Any] | None
) -> Iterator[tuple[str, dict[str, str]]]:
    """Each stage and sink with what there is to say about it: heading -> text."""
    sinks = _sinks_behind(pipeline)
    uncertain = _may_be_absent(pipeline)
    for node in pipeline.nodes.values():
        is_pruned = node in plan.pruned
        facts = {"at": str(node.mark)}
        if is_pruned:
            facts["left out because"] = "no sink needs its output"
        else:
            facts["runs because"] = _reason(node, sinks[node.id])
            if skips := _skips(node, pipeline, uncertain):
                facts["skipped when"] = "; ".join(skips)
        if node.component.kind == "stage":
            facts["memory"] = "pure: runs only when its result is needed"
            if node.component.memory == "stateful":
                facts["memory"] = "stateful: runs in every frame in which its gates are open"
        if not is_pruned:
            facts["segment"] = plan.segment_of(node.id)
        name, origin = node.component.name, node.component.origin
        facts["is"] = name if ":" in name or name == origin else f"{name} ({origin})"
        if statistics is not None and not is_pruned:
            entry = (statistics["stages"] | statistics["sinks"]).get(node.id)
            facts["statistics"] = "not part of that run" if entry is None else _cost(entry)
        yield node.id, facts


def _reason(node: Node, sinks: list[str]) -> str:
    """Why a stage or sink runs."""
    if node.component.kind == "source":
        return "it captures the frames"
    if node.component.kind == "sink":
        rate = "" if node.max_rate is None else f", at most {node.max_rate:g} times a second"
        cls = node.component.cls
        decides = issubclass(cls, Sink) and cls.wants is not Sink.wants
        return f"it is a sink{rate}{'; it decides for each frame whether it needs it' if decides else ''}"
    *others, last = sinks
    return f"{', '.join(others)} and {last} need it" if others else f"{last} needs it"


def _skips(node: Node, pipeline: Pipeline, uncertain: set[str]) -> list[str]:
    """When a stage or sink is skipped."""
    gates = [_gate(gate) for gate in node.gates] if pipeline.skipping else []
    required = [node.inputs[port.name] for port in node.component.ports.inputs if not port.optional]
    return gates + [f"{ref.node} gives no {ref.port}" for ref in required if ref and ref.node in uncertain]


def _gate(gate: Gate) -> str:
    if gate.otherwise == "repeat":
        return f"{gate.signal} is false (its last outputs are repeated)"
    return f"{gate.signal} is false (its outputs are absent: {gate.reason})"


def _may_be_absent(pipeline: Pipeline) -> set[str]:
    """Nodes whose outputs may be missing: gated, with optional outputs, or for want of an input."""
    found: set[str] = set()
    for node in pipeline.nodes.values():
        ports = node.component.ports
        required = [node.inputs[port.name] for port in ports.inputs if not port.optional]
        if (
            (node.gates and pipeline.skipping)
            or any(port.optional for port in ports.outputs)
            or any(ref.node in found for ref in required if ref is not None)
        ):
            found.add(node.id)
    return found


def _sinks_behind(pipeline: Pipeline) -> dict[str, list[str]]:
    """Node -> the sinks that need it, directly or not."""
    behind: dict[str, list[str]] = {id_: [] for id_ in pipeline.nodes}
    for sink in pipeline.sinks:
        pending, visited = [sink.id], {sink.id}
        while pending:
            for id_ in dependencies(pipeline.nodes[pending.pop()]) - visited:
                visited.add(id_)
                pending.append(id_)
                behind[id_].append(sink.id)
    return behind


def add_arguments_graph(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `graph`."""
    add_pipeline(parser)


def run_graph(args: argparse.Namespace) -> int:
    """Print the flowchart."""
    show(_mermaid(*load_plan(args)))
    return 0


def _mermaid(pipeline: Pipeline, plan: Plan) -> Iterator[str]:
    """Lines of a flowchart: segments as boxes, the queues between them as thick arrows, gates dotted.

    Stages that no sink needs stand outside, with a dashed outline.
    """
    nodes = pipeline.nodes
    names = {id_: f"n{index}" for index, id_ in enumerate(nodes)}
    boxes = {segment: f"s{index}" for index, segment in enumerate(plan.segments)}
    yield "flowchart LR"
    for segment, members in plan.segments.items():
        yield f'  subgraph {boxes[segment]}["segment {segment}"]'
        for id_ in members:
            yield f"    {names[id_]}{_shape(nodes[id_])}"
        yield "  end"
    for node in plan.pruned:
        yield f"  {names[node.id]}{_shape(node)}:::pruned"
    for node in nodes.values():
        ports: dict[str, list[str]] = {}
        for ref in node.inputs.values():
            if ref is not None and ref.port not in ports.setdefault(ref.node, []):
                ports[ref.node].append(ref.port)
        for giver, labels in ports.items():
            yield f'  {names[giver]} -->|"{", ".join(labels)}"| {names[node.id]}'
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
