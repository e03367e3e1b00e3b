"""Precedence for the threads of live frames: asked for where the system knows it, given back in need."""

from __future__ import annotations

import logging
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tactflow.engine import priority
from tactflow.engine.priority import AGAIN, MOST, PATIENCE_S, REVIEW_S, Precedence, serve_soon

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


def id_of(thread: threading.Thread) -> int:
    assert thread.native_id is not None
    return thread.native_id


@contextmanager
def reviewed(*threads: threading.Thread, **options: Any) -> Iterator[Precedence]:
    """Precedence for threads, reviewed once; taken back at the end."""
    precedence = Precedence(lambda: [id_of(thread) for thread in threads], **options)
    precedence.review()
    try:
        yield precedence
    finally:
        precedence.stop()


class Load:
    """A clock that is set by hand, and threads that use so many processors by it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.used = 0.0
        monkeypatch.setattr(priority, "_processors", lambda: 2)
        monkeypatch.setattr(priority, "_processor_seconds", lambda _: self.used)
        monkeypatch.setattr(priority.time, "perf_counter", lambda: self.now)

    def goes_on(self, share: float, seconds: float = REVIEW_S) -> None:
        self.now += seconds
        self.used += share * seconds


@pytest.fixture
def realtime() -> None:
    if sys.platform != "linux" or not granted():
        pytest.skip("this user may not have real-time priority here")


@pytest.mark.usefixtures("realtime")
def test_real_time_priority_is_taken_where_it_is_granted_and_not_inherited() -> None:
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
    with reviewed(thread) as precedence:
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

    with waiting_thread() as thread:
        monkeypatch.setattr(os, "sched_setscheduler", refuse)
        with reviewed(thread) as precedence:
            assert precedence.how == ("short slices" if knows_slices() else "ordinary")
            assert policy_of(thread) == os.SCHED_OTHER


@linux
def test_real_time_priority_is_not_asked_for_where_it_is_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda _, policy, __: asked.append(policy))
    with waiting_thread() as thread, reviewed(thread, realtime=False) as precedence:
        assert precedence.how == ("short slices" if knows_slices() else "ordinary")
    assert not any(policy & os.SCHED_RR for policy in asked)


@pytest.mark.usefixtures("realtime")
def test_who_takes_too_much_loses_it_until_there_is_room_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "tactflow")
    load = Load(monkeypatch)
    limit = MOST * 2
    steps = [
        (limit - 0.01, REVIEW_S, os.SCHED_RR),
        (limit + 0.01, REVIEW_S, os.SCHED_OTHER),
        # Not at once: a thread that must share the processors uses less than it wants.
        (0.1, REVIEW_S, os.SCHED_OTHER),
        # Less than what took it away, but not yet less enough.
        (AGAIN * limit + 0.01, PATIENCE_S, os.SCHED_OTHER),
        (AGAIN * limit - 0.01, REVIEW_S, os.SCHED_RR),
        (limit + 0.01, REVIEW_S, os.SCHED_OTHER),
        # The second time it takes twice as long.
        (0.1, 1.5 * PATIENCE_S, os.SCHED_OTHER),
        (0.1, 0.5 * PATIENCE_S, os.SCHED_RR),
    ]
    with waiting_thread() as thread, reviewed(thread) as precedence:
        assert policy_of(thread) == os.SCHED_RR
        for number, (share, seconds, policy) in enumerate(steps):
            load.goes_on(share, seconds)
            precedence.review()
            assert policy_of(thread) == policy, number
    assert caplog.text.count("take 1.0 of 2 processors") == 1
    assert caplog.text.count("live frames go first") == 1


@pytest.mark.usefixtures("realtime")
def test_runs_beside_each_other_share_what_may_be_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    load = Load(monkeypatch)
    with waiting_thread() as thread:
        for runs, policy in ((1, os.SCHED_RR), (4, os.SCHED_OTHER)):
            with reviewed(thread, runs=runs) as precedence:
                load.goes_on(0.3)
                precedence.review()
                assert policy_of(thread) == policy


@pytest.mark.usefixtures("realtime")
def test_threads_that_come_later_get_it_and_those_that_are_left_out_lose_it() -> None:
    threads: list[threading.Thread] = []
    with waiting_thread() as first, waiting_thread() as second:
        precedence = Precedence(lambda: [id_of(thread) for thread in threads])
        for threads in ([first], [first, second], [second]):
            precedence.review()
            got = [policy_of(thread) == os.SCHED_RR for thread in (first, second)]
            assert got == [first in threads, second in threads]
        precedence.stop()
        assert policy_of(second) == os.SCHED_OTHER
        assert precedence.how == "real-time", "it tells what it was"


@pytest.mark.usefixtures("realtime")
def test_a_thread_that_has_just_ended_spoils_nothing() -> None:
    with waiting_thread() as gone:
        pass
    with waiting_thread() as first, reviewed(gone, first) as precedence:
        assert (precedence.how, policy_of(first)) == ("real-time", os.SCHED_RR)


@pytest.mark.usefixtures("realtime")
def test_a_policy_that_somebody_chose_is_kept() -> None:
    with waiting_thread() as chosen, waiting_thread() as other:
        os.sched_setscheduler(id_of(chosen), os.SCHED_FIFO, os.sched_param(7))
        for wanted in (True, False):
            with reviewed(chosen, other, realtime=wanted):
                assert policy_of(chosen) == os.SCHED_FIFO
                assert os.sched_getparam(id_of(chosen)).sched_priority == 7
            assert policy_of(chosen) == os.SCHED_FIFO


@pytest.mark.usefixtures("realtime")
def test_it_watches_by_itself_and_goes_first_too_until_it_is_stopped() -> None:
    with waiting_thread() as thread:
        precedence = Precedence(lambda: [id_of(thread)])
        precedence.start()
        until = time.monotonic() + 10
        while policy_of(precedence._guard) != os.SCHED_RR and time.monotonic() < until:
            time.sleep(0.01)
        assert policy_of(precedence._guard) == os.SCHED_RR
        assert policy_of(thread) == os.SCHED_RR
        precedence.stop()
        assert not precedence._guard.is_alive()
        assert policy_of(thread) == os.SCHED_OTHER


@linux
def test_a_component_that_names_no_threads_properly_is_reported_and_nothing_ends(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def wrong() -> list[int]:
        raise TypeError("'int' object is not iterable")

    precedence = Precedence(wrong)
    precedence.start()
    precedence._guard.join(10)
    assert not precedence._guard.is_alive()
    assert "live frames lose precedence: TypeError: 'int' object is not iterable" in caplog.text


@linux
def test_threads_are_found_by_their_names() -> None:
    name = Path("/proc/thread-self/comm").read_text().strip()
    mine = threading.get_native_id()
    assert mine in priority.threads_named(name[:4])
    assert mine not in priority.threads_named(name[:4], besides=[mine])
    assert priority.threads_named("nobody is called this") == []


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
    assert priority._processor_seconds(more_than_linux_numbers) is None


@linux
def test_threads_of_other_processes_are_not_touched(monkeypatch: pytest.MonkeyPatch) -> None:
    # As when the number of a thread that has ended is given to a thread of another program.
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        monkeypatch.setattr(os, "sched_setscheduler", lambda *_: pytest.fail("it was touched"))
        precedence = Precedence(lambda: [other.pid])
        precedence.review()
        precedence.stop()
        other.communicate(b"\n")
