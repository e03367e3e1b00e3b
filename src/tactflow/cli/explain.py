"""`tactflow explain`: why each stage runs, is skipped or is left out, and what it cost."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from typing import Any

from tactflow.cli.node_summary import NodeSummary, milliseconds, saving
from tactflow.cli.options import add_pipeline_and_stats, load_with_stats
from tactflow.cli.printable import printable
from tactflow.engine.contract import Sink
from tactflow.engine.graph import Gate, Node, Pipeline
from tactflow.engine.plan import Plan, dependencies


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `explain`."""
    add_pipeline_and_stats(parser)


def run(args: argparse.Namespace) -> int:
    """Print a paragraph for each stage and sink."""
    print(printable("\n".join(explanation(*load_with_stats(args)))))
    return 0


def explanation(pipeline: Pipeline, plan: Plan, statistics: Mapping[str, Any] | None = None) -> Iterator[str]:
    """Lines of the explanation.

    statistics : content of a statistics file, or None.
    """
    skipping = "" if pipeline.skipping else ", skipping is off"
    yield f"{pipeline.file}: sensor {pipeline.sensor}, segments {', '.join(plan.segments)}{skipping}"
    if statistics is not None:
        yield _run_line(statistics)
        yield from _saving(pipeline, statistics)
    users = _sinks_behind(pipeline)
    uncertain = _may_be_absent(pipeline)
    pruned = {node.id for node in plan.pruned}
    for node in pipeline.nodes.values():
        yield ""
        yield f"{node.id} ({node.mark})"
        facts = _facts(node, pipeline, plan, users[node.id], uncertain, node.id in pruned)
        if statistics is not None and node.id not in pruned:
            facts["statistics"] = _cost(node, statistics)
        width = max(map(len, facts))
        for name, text in facts.items():
            yield f"  {name.ljust(width)}  {text}"


def _facts(
    node: Node, pipeline: Pipeline, plan: Plan, users: list[str], uncertain: set[str], pruned: bool
) -> dict[str, str]:
    facts: dict[str, str] = {}
    if pruned:
        facts["pruned because"] = "no sink needs what it makes"
    elif node.component.kind == "source":
        facts["runs because"] = "it captures the frames"
    elif node.component.kind == "sink":
        facts["runs because"] = "it is a sink" + _demand(node)
    else:
        facts["runs because"] = f"{_listed(users)} {'needs' if len(users) == 1 else 'need'} it"
    if not pruned:
        skips = [_gate(gate) for gate in node.gates] if pipeline.skipping else []
        needed = [
            f"{ref.node} gives no {ref.port}"
            for port in node.component.ports.inputs
            if not port.optional and (ref := node.inputs[port.name]) and ref.node in uncertain
        ]
        if skips or needed:
            facts["skipped when"] = "; ".join(skips + needed)
    memory = "none (pure): runs only when something wants its result"
    if node.component.memory == "stateful":
        memory = "stateful: sees every frame that is not dropped"
    if node.component.kind == "stage":
        facts["memory"] = memory
    if not pruned:
        facts["segment"] = plan.segment_of(node.id)
    name, origin = node.component.name, node.component.origin
    facts["is"] = name if ":" in name or name == origin else f"{name} ({origin})"
    return facts


def _demand(node: Node) -> str:
    rate = "" if node.max_rate is None else f", at most {node.max_rate:g} times a second"
    cls = node.component.cls
    asks = issubclass(cls, Sink) and cls.wants is not Sink.wants
    own = "; it says for each frame whether it wants it" if asks else ""
    return rate + own


def _gate(gate: Gate) -> str:
    text = f"{gate.signal} is false"
    if gate.otherwise == "repeat":
        text += " (its last outputs are repeated)"
    else:
        text += f" (its outputs are absent: {gate.reason})"
    return text


def _may_be_absent(pipeline: Pipeline) -> set[str]:
    """Nodes whose outputs may be missing: gated, by their own word, or for want of an input."""
    found: set[str] = set()
    for node in pipeline.nodes.values():
        ports = node.component.ports
        needed = [node.inputs[port.name] for port in ports.inputs if not port.optional]
        if (
            (node.gates and pipeline.skipping)
            or any(port.optional for port in ports.outputs)
            or any(ref.node in found for ref in needed if ref is not None)
        ):
            found.add(node.id)
    return found


def _sinks_behind(pipeline: Pipeline) -> dict[str, list[str]]:
    """Node -> the sinks that need it, directly or not."""
    behind: dict[str, list[str]] = {id_: [] for id_ in pipeline.nodes}
    for sink in pipeline.sinks:
        pending, seen = [sink.id], {sink.id}
        while pending:
            for other in dependencies(pipeline.nodes[pending.pop()]) - seen:
                seen.add(other)
                pending.append(other)
                behind[other].append(sink.id)
    return behind


def _listed(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def _run_line(statistics: Mapping[str, Any]) -> str:
    latency = statistics["latency_ms"]
    return (
        f"the run: {statistics['frames']} frames in {statistics['wall_s']:.1f} s, "
        f"{statistics['dropped']} dropped, latency p50 {_ms(latency['p50'])}, p99 {_ms(latency['p99'])}, "
        f"end: {statistics['end']}"
    )


def _saving(pipeline: Pipeline, statistics: Mapping[str, Any]) -> Iterator[str]:
    """What skipping saved in all stages together, and how that is counted."""
    stages = [node.id for node in pipeline.nodes.values() if node.component.kind == "stage"]
    summaries = [NodeSummary.of(entry) for id_, entry in statistics["stages"].items() if id_ in stages]
    saved = sum(summary.saved_ms or 0.0 for summary in summaries)
    spent = sum(summary.spent_ms for summary in summaries)
    if statistics["frames"] and saved + spent > 0:
        yield f"all stages: {saving(saved, saved + spent, statistics['frames'])}"
        yield "            (saved = frames skipped x mean time of a run; of = that + the time spent)"


def _cost(node: Node, statistics: Mapping[str, Any]) -> str:
    entry = {**statistics.get("sinks", {}), **statistics["stages"]}.get(node.id)
    if entry is None:
        return "not part of that run"
    summary = NodeSummary.of(entry)
    if node.component.kind != "sink":
        return summary.told()
    # A sink in its own thread only gets the frames that it asked for.
    times = "once" if summary.runs == 1 else f"{summary.runs} times"
    cost = (
        f", {milliseconds(summary.mean_ms)} each (p99 {milliseconds(summary.p99_ms)})" if summary.runs else ""
    )
    return f"written {times} in {statistics['frames']} frames{cost}"


def _ms(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} ms"
