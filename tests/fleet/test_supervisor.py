"""When a sensor is started, started again and given up: with processes and a clock that are made up."""

from __future__ import annotations

import io
import math
import os
import signal
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tactflow.fleet.heartbeat import HANG_AFTER, MAX_INTERVAL, Watchdog, progress_of
from tactflow.fleet.supervisor import FIRST_PAUSE, GIVE_UP_AFTER, GOOD_RUN, LONGEST_PAUSE, Member, Supervisor
from tactflow.system.signals import ending_handled


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def pause(self, seconds: float) -> None:
        self.now += seconds


class Process:
    """Ends by itself after so many seconds with an exit code; a signal ends it at once, unless it hangs.

    Until `silent_after` seconds it touches a file.
    """

    hangs = False

    def __init__(
        self, clock: Clock, lasts: float, code: int, alive: Path, silent_after: float = math.inf
    ) -> None:
        self._alive, self._silent_at = alive, clock.now + silent_after
        self.stdin, self.stdout, self.stderr = io.BytesIO(), io.BytesIO(), io.BytesIO()
        self._clock, self._ends, self._code = clock, clock.now + lasts, code
        self.signals: list[int] = []

    def poll(self) -> int | None:
        if self._clock.now < self._silent_at:
            now = round(self._clock.now * 1e9)
            self._alive.touch()
            os.utime(self._alive, ns=(now, now))
        return self._code if self._clock.now >= self._ends else None

    def send_signal(self, number: int) -> None:
        self.signals.append(number)
        if not self.hangs:
            self._ends, self._code = self._clock.now, -number

    def kill(self) -> None:
        self._ends, self._code = self._clock.now, -signal.SIGKILL


class Machine:
    """Starts processes as planned: sensor -> how long each of its processes lasts, and its exit code.

    After that, a third number says when it falls silent.
    """

    def __init__(
        self, folder: Path, plans: dict[str, list[tuple[float, int] | tuple[float, int, float]]]
    ) -> None:
        self.folder = folder
        self.clock = Clock()
        self._plans = plans
        self.starts: dict[str, list[float]] = {sensor: [] for sensor in plans}

    def start(self, command: Sequence[str]) -> Any:
        sensor = command[0]
        starts = self.starts[sensor]
        plan = self._plans[sensor]
        lasts, code, *silent_after = plan[min(len(starts), len(plan) - 1)]
        starts.append(self.clock.now)
        return Process(self.clock, lasts, code, self.folder / sensor, *silent_after)

    def run(self) -> int:
        members = [Member(sensor, [sensor], Watchdog(self.folder / sensor)) for sensor in self._plans]
        supervisor = Supervisor(self.start, self.clock, self.clock.pause)
        with ending_handled(supervisor.count_signal):
            return supervisor.run(members)


@pytest.mark.parametrize(("code", "end"), [(4, 4), (-signal.SIGKILL, 3)])
def test_the_pause_before_a_new_start_doubles_until_the_sensor_is_given_up(
    code: int, end: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(tmp_path, {"left": [(0.0, code)], "right": [(100.0, 0)]})
    assert machine.run() == end
    starts = machine.starts["left"]
    gaps = [later - earlier for earlier, later in pairwise(starts)]
    expected = [min(FIRST_PAUSE * 2**number, LONGEST_PAUSE) for number in range(GIVE_UP_AFTER)]
    assert gaps == pytest.approx(expected, abs=0.2)
    said = capsys.readouterr().err
    assert "given up" in said
    assert ("was ended by signal 9" in said) == (code < 0)
    assert len(machine.starts["right"]) == 1


def test_after_a_good_run_the_first_pause_comes_again(tmp_path: Path) -> None:
    machine = Machine(tmp_path, {"left": [(0.0, 3), (0.0, 3), (GOOD_RUN + 1, 3), (1.0, 0)]})
    assert machine.run() == 0
    starts = machine.starts["left"]
    assert starts[3] - starts[2] == pytest.approx(GOOD_RUN + 1 + FIRST_PAUSE, abs=0.2)


def test_a_mistake_in_the_command_line_ends_the_other_sensors(tmp_path: Path) -> None:
    machine = Machine(tmp_path, {"left": [(1.0, 2)], "right": [(1000.0, 0)]})
    assert machine.run() == 2
    assert machine.clock.now < 10
    assert machine.starts == {"left": [0.0], "right": [0.0]}


@pytest.mark.parametrize(
    ("hangs", "code"),
    [(True, 130), (False, 0)],
    ids=["third signal kills", "ends before its handler is there"],
)
def test_signals_end_a_process(
    hangs: bool, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Process, "hangs", hangs)
    machine = Machine(tmp_path, {"left": [(1e9, 0)]})
    before = machine.clock.pause
    signals = iter(range(3 if hangs else 1))

    def pause(seconds: float) -> None:
        before(seconds)
        if machine.clock.now > 1 and next(signals, None) is not None:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(machine.clock, "pause", pause)
    assert machine.run() == code


def test_a_process_that_has_no_heartbeat_is_killed_and_started_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = Machine(tmp_path, {"left": [(1e9, 0, 10.0), (1e9, 0, 10.0), (1.0, 0)], "right": [(1000.0, 0)]})
    assert machine.run() == 0
    starts = machine.starts["left"]
    gaps = [later - earlier for earlier, later in pairwise(starts)]
    # It lived for ten seconds only, so the pause doubles.
    assert gaps == pytest.approx([10 + HANG_AFTER + FIRST_PAUSE, 10 + HANG_AFTER + 2 * FIRST_PAUSE], abs=0.5)
    assert capsys.readouterr().err.count("left has hung for 60 s and is killed\n") == 2
    assert machine.starts["right"] == [0.0]


def test_what_the_supervisor_has_slept_through_is_no_silence(tmp_path: Path) -> None:
    watchdog = Watchdog(tmp_path / "alive")
    watchdog.start(0.0)
    watchdog.expired(1000.0)
    assert watchdog.silent == MAX_INTERVAL


def test_to_start_a_sensor_has_time_whatever_it_may_take_for_a_frame(tmp_path: Path) -> None:
    watchdog = Watchdog(tmp_path / "alive", timeout=2.0)
    watchdog.start(0.0)
    assert sum(not watchdog.expired(float(second)) for second in range(100)) == HANG_AFTER + 1
    watchdog.start(100.0)
    watchdog.path.touch()
    assert not watchdog.expired(101.0)
    assert [watchdog.expired(101.0 + second) for second in (1.0, 2.0, 3.0)] == [False, False, True]


def test_there_is_progress_when_every_thread_is_in_another_call_or_waits() -> None:
    calls = {"compute": 1, "heavy": 1}
    progress = progress_of(lambda: dict(calls))
    assert progress()
    calls["compute"] += 1
    assert not progress(), "the other one is in the same call"
    calls["heavy"] += 1
    assert progress()
    assert not progress()
    calls.clear()
    assert progress()
