"""Precedence for the threads of live frames: asked for where the system knows it, given back in need."""

from __future__ import annotations

import itertools
import logging
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from tactflow.engine import priority
from tactflow.engine.priority import AGAIN, MOST, REVIEW_S, Precedence, serve_soon

linux = pytest.mark.skipif(sys.platform != "linux", reason="real-time priority is asked for on Linux only")


def in_a_thread(work: Callable[[], object]) -> object:
    """Run in a thread of its own, so that the test's own keeps its slices."""
    found: list[object] = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join()
    return found[0]


def knows_slices() -> bool:
    """Whether this kernel is Linux 6.12 or newer."""
    if platform.system() != "Linux" or platform.machine() not in priority._CALLS:
        return False
    major, minor = (int(part) for part in platform.release().split(".")[:2])
    return (major, minor) >= (6, 12)


def test_slices_are_granted_by_kernels_that_know_them() -> None:
    if not knows_slices():
        pytest.skip("slices can be asked for from Linux 6.12 on")
    assert in_a_thread(serve_soon) is True


def test_policy_and_nice_value_stay() -> None:
    def ask() -> tuple[object, object]:
        def kept() -> tuple[int, int]:
            return os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), os.sched_getscheduler(0)

        before = kept()
        serve_soon()
        return before, kept()

    before, after = in_a_thread(ask)  # type: ignore[misc]
    assert before == after


@pytest.mark.parametrize(
    ("system", "machine"), [("Darwin", "arm64"), ("Windows", "AMD64"), ("Linux", "riscv64")]
)
def test_other_systems_are_left_alone(system: str, machine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(priority.ctypes, "CDLL", lambda _: pytest.fail("the system was called"))
    assert serve_soon() is False


def test_a_slice_that_no_kernel_grants_is_refused_and_nothing_raised() -> None:
    # Longer than Linux allows (100 ms): it grants less, or nothing.
    assert in_a_thread(lambda: serve_soon(10**12)) is False


# -- real-time priority ------------------------------------------------------------------------------------


@contextmanager
def waiting_thread() -> Iterator[threading.Thread]:
    """A thread that does nothing."""
    end = threading.Event()
    thread = threading.Thread(target=end.wait)
    thread.start()
    try:
        yield thread
    finally:
        end.set()
        thread.join()


def policy_of(thread: threading.Thread) -> int:
    assert thread.native_id is not None
    return os.sched_getscheduler(thread.native_id) & ~os.SCHED_RESET_ON_FORK


def granted() -> bool:
    """Whether this process may have real-time priority."""

    def ask() -> bool:
        try:
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        except OSError:
            return False
        return True

    return bool(in_a_thread(ask))


class Load:
    """A clock that is set by hand, and threads that use so many processors by it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.used = 0.0
        monkeypatch.setattr(priority, "_processors", lambda: 2)
        monkeypatch.setattr(priority, "_processor_seconds", lambda _: self.used)
        monkeypatch.setattr(priority.time, "perf_counter", lambda: self.now)

    def goes_on(self, share: float) -> None:
        self.now += REVIEW_S
        self.used += share * REVIEW_S


@linux
def test_real_time_priority_is_taken_where_it_is_granted_and_not_inherited() -> None:
    if not granted():
        pytest.skip("this user may not have real-time priority")
    found: list[int] = []
    begin = threading.Event()

    def work() -> None:
        begin.wait()
        child = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0)))
        child.start()
        child.join()
        asked = "import os; print(os.sched_getscheduler(0))"
        found.append(
            int(subprocess.run([sys.executable, "-c", asked], capture_output=True, check=True).stdout)
        )

    thread = threading.Thread(target=work)
    thread.start()
    precedence = Precedence()
    precedence.review([thread])
    assert precedence.how == "real-time"
    assert policy_of(thread) == os.SCHED_RR
    begin.set()
    thread.join()
    assert found == [os.SCHED_OTHER, os.SCHED_OTHER]
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@linux
def test_without_the_right_threads_get_short_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    precedence = Precedence()
    with waiting_thread() as thread:
        precedence.review([thread])
        assert precedence.how == ("short slices" if knows_slices() else "ordinary")
        assert policy_of(thread) == os.SCHED_OTHER


@linux
def test_real_time_priority_is_not_asked_for_where_it_is_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: pytest.fail("it was asked for"))
    precedence = Precedence(realtime=False)
    with waiting_thread() as thread:
        precedence.review([thread])
        assert precedence.how == ("short slices" if knows_slices() else "ordinary")


@linux
def test_who_takes_too_much_loses_it_until_there_is_room_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if not granted():
        pytest.skip("this user may not have real-time priority")
    caplog.set_level(logging.INFO, "tactflow")
    load = Load(monkeypatch)
    precedence = Precedence()
    limit = MOST * 2
    steps = [
        (limit - 0.01, os.SCHED_RR),
        (limit + 0.01, os.SCHED_OTHER),
        # Less than what took it away, but not yet less enough: no to and fro.
        (limit - 0.01, os.SCHED_OTHER),
        (AGAIN * limit + 0.01, os.SCHED_OTHER),
        (AGAIN * limit - 0.01, os.SCHED_RR),
    ]
    with waiting_thread() as thread:
        precedence.review([thread])
        assert policy_of(thread) == os.SCHED_RR
        for share, policy in steps:
            load.goes_on(share)
            precedence.review([thread])
            assert policy_of(thread) == policy, share
    assert "take 1.0 of 2 processors" in caplog.text


@linux
def test_runs_beside_each_other_share_what_may_be_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    if not granted():
        pytest.skip("this user may not have real-time priority")
    load = Load(monkeypatch)
    with waiting_thread() as thread:
        for runs, policy in ((1, os.SCHED_RR), (4, os.SCHED_OTHER)):
            precedence = Precedence(runs=runs)
            precedence.review([thread])
            load.goes_on(0.3)
            precedence.review([thread])
            assert policy_of(thread) == policy


@linux
def test_threads_that_come_later_get_it_too_and_ended_ones_are_left_out() -> None:
    if not granted():
        pytest.skip("this user may not have real-time priority")
    clock = itertools.count()
    with pytest.MonkeyPatch.context() as patch, waiting_thread() as first:
        patch.setattr(priority.time, "perf_counter", lambda: float(next(clock)))
        precedence = Precedence()
        with waiting_thread() as second:
            precedence.review([first])
            assert policy_of(second) == os.SCHED_OTHER
            precedence.review([first, second])
            assert policy_of(second) == os.SCHED_RR
        precedence.review([first, second])
        assert (precedence.how, policy_of(first)) == ("real-time", os.SCHED_RR)


@linux
def test_the_time_a_thread_had_is_that_of_its_own_clock() -> None:
    found: list[tuple[float, float, float]] = []

    def work() -> None:
        while time.thread_time() < 0.05:
            pass
        before = time.thread_time()
        found.append((before, priority._processor_seconds(threading.get_native_id()), time.thread_time()))

    in_a_thread(work)
    before, told, after = found[0]
    assert before <= told <= after


@linux
def test_the_time_of_a_thread_that_is_not_there_is_none() -> None:
    more_than_linux_numbers = 2**25
    assert priority._processor_seconds(more_than_linux_numbers) == 0.0
