"""Ticks as mappings, and the sink that carries every result of a run into Python."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tactflow.engine.collect import with_collector
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.engine.run import Runner

MakeRunner = Callable[..., Runner]
FRAME = Frame("main", 7, 0.1, np.zeros((4, 6, 3), np.uint8))
PULSE = [i for i in range(20) if 3 <= i % 10 <= 6]


class Brightness(Tick):
    brightness: float | None


def collected(runner: Runner, **options: Any) -> list[Tick]:
    """What a collector gets in place of the pipeline's sinks."""
    ticks: list[Tick] = []
    result = Runner(with_collector(runner.pipeline, Tick, ticks.append, name="a.test", **options)).run()
    assert result.error is None
    return ticks


def test_a_tick_is_a_mapping_of_values_or_reasons() -> None:
    tick = Brightness(FRAME, {"brightness": 3.0, "contact": Absent("no_contact")})
    assert dict(tick) == {"brightness": 3.0, "contact": Absent("no_contact")}
    assert (tick.brightness, tick.value("contact"), tick.value("nothing")) == (3.0, None, None)
    assert tick.skipped == {"contact": "no_contact"}
    assert not tick["contact"]
    with pytest.raises(KeyError, match="no stage gives the port flow; there are brightness, contact"):
        tick["flow"]


def test_a_tick_can_be_copied_compared_and_sent_to_another_process() -> None:
    tick = Brightness(FRAME, {"brightness": np.zeros(3)})
    assert tick == tick
    assert tick != tick.replace(brightness=2.0)
    assert tick.replace(brightness=2.0).brightness == 2.0
    assert list(pickle.loads(pickle.dumps(tick))) == ["brightness"]
    assert repr(tick) == "<Brightness main 7 at 0.100 s: brightness>"


def test_a_collector_gets_every_port_in_every_frame(toy_runner: MakeRunner) -> None:
    ticks = collected(toy_runner())
    assert [tick.frame.seq for tick in ticks] == list(range(20))
    assert [tick["total"].value for tick in ticks] == [sum(range(i + 1)) for i in range(20)]
    assert [i for i, tick in enumerate(ticks) if tick.value("gated")] == PULSE
    assert ticks[0]["gated"] == Absent("idle")


@pytest.mark.parametrize("background", [True, False])
def test_collecting_computes_nothing_that_only_a_closed_gate_would_need(
    toy_runner: MakeRunner, background: bool
) -> None:
    ticks = collected(toy_runner(), background=background)
    assert [i for i, tick in enumerate(ticks) if tick.value("heavy")] == PULSE
    assert ticks[0]["heavy"] == Absent("no_demand")


def test_two_outputs_of_one_name_have_the_names_of_their_stages_too(toy_runner: MakeRunner) -> None:
    tick = collected(toy_runner({"second": {"use": "Level"}}))[5]
    assert tick["level"] is tick["second.level"]
    assert tick["level"] is not tick["level.level"]
