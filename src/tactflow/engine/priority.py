"""Which thread the operating system runs first.

A thread that works on a live frame wants little of the processor, and at once. An ordinary scheduler shares
the processor out evenly: such a thread waits behind a browser or a renderer, for milliseconds.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import platform
import struct
import sys
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Literal

log = logging.getLogger("tactflow")

How = Literal["ordinary", "short slices", "real-time"]
"""How the operating system treats the threads of live frames."""

_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Numbers of the system calls `sched_setattr` and `sched_getattr`, which the C library does not name."""
_ATTRIBUTES = struct.Struct("<IIQiIQQQ")
"""size, policy, flags, nice, priority, runtime, deadline, period: Linux's `struct sched_attr`."""
_ORDINARY = 0
"""The policy SCHED_OTHER, for which `runtime` is the length of a slice."""
SHORTEST = 100_000
"""The shortest slice that Linux knows, ns."""

ZMQ_SENDS = "ZMQbg/IO"
"""What ZeroMQ calls the threads in which it sends."""

MOST = 0.5
"""Using more than this part of the processors, a run loses its real-time priority: others must live too."""
AGAIN = 0.75
"""Using less than so much of that, it may get it back."""
REVIEW_S = 0.5
"""Time over which use is counted, s."""
PATIENCE_S = 2.0
"""After a loss, so long at least without it, s; twice as long after each further loss."""
MOST_PATIENCE_S = 64.0
"""Never longer than this, s."""


def serve_soon(thread: int = 0, slice_ns: int = SHORTEST) -> bool:
    """Ask for short slices of the processor for a thread, so that it is run soon once it has work.

    Else it waits behind one that wants much until that one's slice is over, some 3 ms. Nobody gets less of
    the processor in all: this is how Linux's scheduler is told one from the other (EEVDF; I. Stoica and
    H. Abdel-Wahab, "Earliest Eligible Virtual Deadline First", 1995; slices can be asked for from Linux 6.12
    on). Needs no rights.

    thread : its native id; 0 is the calling one. slice_ns : length of a slice, 100 000 to 100 000 000 ns.
    Returns whether it was granted. On other systems, on older kernels and for threads under another policy
    nothing changes.
    """
    if platform.system() != "Linux" or platform.machine() not in _CALLS:
        return False
    put, get = _CALLS[platform.machine()]
    call: Any = ctypes.CDLL(None).syscall
    held = ctypes.create_string_buffer(_ATTRIBUTES.size)
    if call(get, thread, held, _ATTRIBUTES.size, 0) != 0:
        return False
    size, policy, flags, nice, priority, *_ = _ATTRIBUTES.unpack(held.raw)
    if policy != _ORDINARY:
        return False
    wanted = _ATTRIBUTES.pack(size, policy, flags, nice, priority, slice_ns, 0, 0)
    if call(put, thread, ctypes.create_string_buffer(wanted, _ATTRIBUTES.size), 0) != 0:
        return False
    # Older kernels take any number and keep none.
    done = call(get, thread, held, _ATTRIBUTES.size, 0) == 0
    return bool(done and _ATTRIBUTES.unpack(held.raw)[5] == slice_ns)


def threads_named(prefix: str, besides: Collection[int] = ()) -> list[int]:
    """Native ids of this process's threads whose names for the system begin like this; none but on Linux.

    For threads that a library has started and does not tell of. besides : those that are not meant.
    """
    tasks = Path("/proc/self/task")
    found: list[int] = []
    for task in tasks.iterdir() if tasks.exists() else ():
        # A thread may end meanwhile.
        with contextlib.suppress(OSError):
            if int(task.name) not in besides and (task / "comm").read_text().startswith(prefix):
                found.append(int(task.name))
    return found


class Precedence:
    """Lets a run's threads go before everybody else's, as far as the system grants it and others can live.

    Real-time priority (SCHED_RR, the lowest of its levels) takes rights: root's, or a limit `rtprio` for the
    user. Without them, and after the threads have taken too much, they get short slices. A thread whose
    policy was chosen by somebody else keeps it.

    Parameters
    ----------
    threads : tells the native ids of the threads that live frames wait for, None for one that has not started
        yet; called twice a second.
    realtime : whether to ask for real-time priority at all.
    runs : how many runs share this machine evenly. work : what the threads do, for messages.
    """

    def __init__(
        self,
        threads: Callable[[], Collection[int | None]],
        realtime: bool = True,
        runs: int = 1,
        work: str = "live frames",
    ) -> None:
        self.how: How = "ordinary"
        self._work = work
        self._threads = threads
        self._realtime = realtime
        self._most = MOST * _processors() / runs
        # Seconds of processor time of the threads that are looked after, at the last review.
        self._used: dict[int, float] = {}
        self._foreign: set[int] = set()
        self._reviewed = float("-inf")
        self._patience = PATIENCE_S
        self._ask_at = float("-inf")
        self._end = threading.Event()
        # A thread of its own, which goes first as well: where others take all there is, an ordinary one would
        # come too late to stop them.
        self._guard = threading.Thread(target=self._watch, name="tactflow-priority", daemon=True)

    def start(self) -> None:
        """Give precedence, and look after it from now on. Does nothing on systems other than Linux."""
        if sys.platform == "linux":
            self._guard.start()

    def stop(self) -> None:
        """Take it back from all threads that are still there; `how` tells what it was."""
        self._end.set()
        if self._guard.is_alive():
            self._guard.join(REVIEW_S)
        for thread in self._used:
            _become_ordinary(thread)

    def _watch(self) -> None:
        try:
            while not self._end.is_set():
                self.review()
                self._end.wait(REVIEW_S)
        except Exception as error:
            log.warning("%s lose precedence: %s: %s", self._work, type(error).__name__, error)
            self._step_back(self._used)

    def review(self) -> None:
        """Give or take, by what the threads have used since the last review."""
        now = time.perf_counter()
        used, gone = self._look({*self._threads(), self._guard.native_id})
        # Of a thread that was not there the last time, nothing is known yet.
        spent = sum(seconds - self._used.get(thread, seconds) for thread, seconds in used.items())
        share = spent / (now - self._reviewed)
        new = used.keys() - self._used.keys()
        self._used, self._reviewed = used, now
        # A reader that hung and was replaced is not counted any more.
        for thread in gone:
            _become_ordinary(thread)
        if self.how == "real-time" and share > self._most:
            self._step_back(used)
            self._tell_loss(share)
            self._ask_at = now + self._patience
            self._patience = min(2 * self._patience, MOST_PATIENCE_S)
        elif (
            self._realtime and self.how != "real-time" and share < AGAIN * self._most and now >= self._ask_at
        ):
            if self._go_first(used) and self._ask_at < 0:
                log.info("%s go first: they have real-time priority", self._work)
        elif new and self.how == "real-time":
            self._go_first(new)
        elif new:
            self._step_back(used)

    def _look(self, threads: Collection[int | None]) -> tuple[dict[int, float], set[int]]:
        """Processor seconds of the threads that are to be looked after, and those that were until now."""
        used: dict[int, float] = {}
        for thread in threads:
            seconds = None if thread is None else _processor_seconds(thread)
            if thread is None or seconds is None or thread in self._foreign:
                continue
            if thread not in self._used and not _is_ordinary(thread):
                self._foreign.add(thread)
            else:
                used[thread] = seconds
        return used, set(self._used) - used.keys()

    def _go_first(self, threads: Collection[int]) -> bool:
        """Give threads real-time priority. Where it is refused none keeps it, nor is it asked for again."""
        self._realtime = all(_become_realtime(thread) for thread in threads)
        if self._realtime:
            self.how = "real-time"
        else:
            self._step_back(self._used)
        return self._realtime

    def _step_back(self, threads: Collection[int]) -> None:
        """Let threads do without real-time priority, with short slices where those are granted."""
        for thread in threads:
            _become_ordinary(thread)
        granted = [serve_soon(thread) for thread in threads]
        self.how = "short slices" if all(granted) else "ordinary"

    def _tell_loss(self, share: float) -> None:
        if self._patience == PATIENCE_S:
            log.warning(
                "%s take %.1f of %d processors: they lose their real-time priority until they take less",
                self._work,
                share,
                _processors(),
            )


def _processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _processor_seconds(thread: int) -> float | None:
    """Time for which a thread of this process has had a processor, s; None if there is no such thread."""
    if sys.platform == "linux":
        # The clock of a thread, as Linux makes its number of the thread's (CPUCLOCK_PERTHREAD). Asking for
        # one of another process is refused.
        with contextlib.suppress(OSError):
            return time.clock_gettime((~thread << 3) | 6)
    return None


def _is_ordinary(thread: int) -> bool:
    """Whether a thread runs under the policy that everything has unless somebody says otherwise."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            return os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    return False


def _become_realtime(thread: int) -> bool:
    """Give a thread real-time priority; False if that is refused. One that has ended needs none."""
    if sys.platform == "linux":
        try:
            # What the thread starts itself, other programs among them, stays ordinary.
            policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(thread, policy, os.sched_param(os.sched_get_priority_min(os.SCHED_RR)))
        except ProcessLookupError:
            return True
        except OSError:
            return False
        return True
    return False


def _become_ordinary(thread: int) -> None:
    """Take real-time priority back from a thread that was given it, if it is still there."""
    if sys.platform == "linux" and _processor_seconds(thread) is not None:
        with contextlib.suppress(OSError):
            # Who has no more than the right to real-time priority may not clear what came with it.
            os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
