"""The flat list of each segment: its order, and when each node of it is needed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tactflow.engine.plan import make_plan
from tactflow.engine.run import Runner
from tactflow.engine.schedule import make_schedule

MakeRunner = Callable[..., Runner]


def needs(runner: Runner) -> dict[str, set[tuple[str, str]]]:
    """Node -> its needs, each as (sinks or always, signals)."""
    steps = [step for steps in make_schedule(make_plan(runner.pipeline)).values() for step in steps]
    return {
        step.node.id: {
            (
                "always" if need.sinks is None else "+".join(sorted(need.sinks)),
                "+".join(sorted(map(str, need.signals))),
            )
            for need in step.needs
        }
        for step in steps
    }


def order(runner: Runner) -> list[str]:
    """All nodes, segment by segment."""
    return [step.node.id for steps in make_schedule(make_plan(runner.pipeline)).values() for step in steps]


def test_every_node_comes_after_what_it_takes_from(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"gated": {"when": "active"}})
    found = order(runner)
    for node in runner.pipeline.nodes.values():
        if node.id in found:
            makers = [ref.node for ref in node.inputs.values() if ref] + [g.signal.node for g in node.gates]
            assert all(found.index(maker) < found.index(node.id) for maker in makers if maker in found)


def test_who_remembers_is_always_needed_and_so_is_what_it_takes_from(toy_runner: MakeRunner) -> None:
    found = needs(toy_runner())
    assert ("always", "") in found["total"]
    assert found["level"] == {("always", "")}


def test_what_only_a_sink_asks_for_is_needed_when_the_sink_wants_the_frame(toy_runner: MakeRunner) -> None:
    found = needs(toy_runner(sinks={"out": {"use": "Collect"}, "far": {"use": "ThreadedCollect"}}))
    assert found["join"] == {("far+out", "")}
    assert found["out"] == {("out", "")}


def test_what_only_a_gated_stage_needs_is_needed_while_the_gate_is_open(toy_runner: MakeRunner) -> None:
    found = needs(toy_runner({"gated": {"when": "active"}}))
    assert found["heavy"] == {("out", "pulse.active")}
    # The gate itself is looked at whenever its stage is asked for.
    assert found["pulse"] == {("out", "")}


def test_makers_of_signals_come_before_what_their_gates_spare(toy_runner: MakeRunner) -> None:
    found = order(toy_runner({"gated": {"when": "active"}}))
    assert found.index("pulse") < found.index("heavy")


def test_a_signal_from_a_later_segment_does_not_spare_anything(toy_runner: MakeRunner) -> None:
    apart: dict[str, Any] = {"gated": {"when": "active"}, "pulse": {"segment": "late"}}
    apart["gated"]["segment"] = "late"
    assert needs(toy_runner(apart))["heavy"] == {("out", "")}


def test_without_skipping_there_are_no_signals_to_wait_for(toy_runner: MakeRunner) -> None:
    found = needs(toy_runner({"gated": {"when": "active"}}, skipping=False))
    assert found["heavy"] == {("out", "")}


@pytest.mark.parametrize("otherwise", ["absent", "repeat"])
def test_a_gate_that_repeats_makes_its_stage_see_every_frame(toy_runner: MakeRunner, otherwise: str) -> None:
    found = needs(toy_runner({"gated": {"when": {"signal": "active", "otherwise": otherwise}}}))
    assert (("always", "") in found["gated"]) == (otherwise == "repeat")


def test_a_maker_that_is_only_needed_behind_another_signal_comes_after_that_signal(
    toy_runner: MakeRunner,
) -> None:
    stages: dict[str, Any] = {
        "behind": {"use": "Gated", "when": "pulse.active"},
        "even": {"use": "Even"},
        "front": {"use": "Heavy", "in": {"level": "behind.gated"}, "when": "even.active"},
        **dict.fromkeys(("gated", "total", "join")),
    }
    runner = toy_runner(stages, {"out": {"use": "OnlyLevel", "in": {"level": "front.heavy"}}})
    assert order(runner).index("even") < order(runner).index("pulse")
    assert needs(runner)["pulse"] == {("out", "even.active")}
    assert needs(runner)["heavy"] == {("out", "even.active+pulse.active")}
