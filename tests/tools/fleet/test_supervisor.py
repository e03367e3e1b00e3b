"""When a sensor is started, started again and given up: with processes and a clock that are made up."""

from __future__ import annotations

import io
import signal
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest

from tactflow.system.signals import ending_handled
from tactflow.tools.fleet.supervisor import (
    FIRST_PAUSE_S,
    GOOD_RUN_S,
    MAX_FAILURES,
    MAX_PAUSE_S,
    Member,
    Supervisor,
)


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def pause(self, seconds: float) -> None:
        self.now += seconds


class Process:
    """Ends by itself after so many seconds with an exit code; a signal ends it at once, unless it hangs."""

    hangs = False

    def __init__(self, clock: Clock, lasts: float, code: int) -> None:
        self.stdin, self.stdout, self.stderr = io.BytesIO(), io.BytesIO(), io.BytesIO()
        self._clock, self._ends, self._code = clock, clock.now + lasts, code
        self.signals: list[int] = []

    def poll(self) -> int | None:
        return self._code if self._clock.now >= self._ends else None

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        if not self.hangs:
            self._ends, self._code = self._clock.now, -number

    def kill(self) -> None:
        self._ends, self._code = self._clock.now, -signal.SIGKILL


class Machine:
    """Starts processes as planned: sensor -> how long each of its processes lasts, and its exit code."""

    def __init__(self, plans: dict[str, list[tuple[float, int]]]) -> None:
        self.clock = Clock()
        self._plans = plans
        self.starts: dict[str, list[float]] = {sensor: [] for sensor in plans}

    def start(self, command: Sequence[str]) -> Any:
        sensor = command[0]
        starts = self.starts[sensor]
        plan = self._plans[sensor]
        lasts, code = plan[min(len(starts), len(plan) - 1)]
        starts.append(self.clock.now)
        return Process(self.clock, lasts, code)

    def run(self) -> int:
        members = [Member(sensor, [sensor]) for sensor in self._plans]
        supervisor = Supervisor(self.start, self.clock, self.clock.pause)
        with ending_handled(supervisor.count_signal):
            return supervisor.run(members)


@pytest.mark.parametrize(("code", "end"), [(4, 4), (-signal.SIGKILL, 3)])
def test_the_pause_before_a_new_start_doubles_until_the_sensor_is_given_up(
    code: int, end: int, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine({"left": [(0.0, code)], "right": [(100.0, 0)]})
    assert machine.run() == end
    starts = machine.starts["left"]
    gaps = [later - earlier for earlier, later in pairwise(starts)]
    expected = [min(FIRST_PAUSE_S * 2**number, MAX_PAUSE_S) for number in range(MAX_FAILURES)]
    assert gaps == pytest.approx(expected, abs=0.2)
    said = capsys.readouterr().err
    assert "given up" in said
    assert ("was ended by signal 9" in said) == (code < 0)
    assert len(machine.starts["right"]) == 1


def test_after_a_good_run_the_first_pause_comes_again() -> None:
    machine = Machine({"left": [(0.0, 3), (0.0, 3), (GOOD_RUN_S + 1, 3), (1.0, 0)]})
    assert machine.run() == 0
    starts = machine.starts["left"]
    assert starts[3] - starts[2] == pytest.approx(GOOD_RUN_S + 1 + FIRST_PAUSE_S, abs=0.2)


def test_a_mistake_in_the_command_line_ends_the_other_sensors() -> None:
    machine = Machine({"left": [(1.0, 2)], "right": [(1000.0, 0)]})
    assert machine.run() == 2
    assert machine.clock.now < 10
    assert machine.starts == {"left": [0.0], "right": [0.0]}


@pytest.mark.parametrize(
    ("hangs", "code"),
    [(True, 130), (False, 0)],
    ids=["third signal kills", "ends before its handler is there"],
)
def test_signals_end_a_process(hangs: bool, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Process, "hangs", hangs)
    machine = Machine({"left": [(1e9, 0)]})
    before = machine.clock.pause
    signals = iter(range(3 if hangs else 1))

    def pause(seconds: float) -> None:
        before(seconds)
        if machine.clock.now > 1 and next(signals, None) is not None:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(machine.clock, "pause", pause)
    assert machine.run() == code
