"""Which thread the operating system runs first.

A thread that works on a live frame wants little of the processor, and at once. An ordinary scheduler shares
the processor out evenly: such a thread waits behind a browser or a renderer, for milliseconds.
"""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import struct
import sys
import threading
import time
from collections.abc import Collection
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

MOST = 0.5
"""Of the processors, this part at most is used with real-time priority: the rest is for everybody else."""
AGAIN = 0.75
"""Times that, and less, it is given back."""
REVIEW_S = 0.5
"""Time over which that is counted, s."""


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


class Precedence:
    """Lets a run's threads go before everybody else's, as far as the system grants it and others can live.

    Real-time priority (SCHED_RR, the lowest of its levels) takes rights: root's, or a limit `rtprio` for the
    user. Without them, and while the threads want more than `MOST` of all processors, they get short slices.

    Parameters
    ----------
    realtime : whether to ask for real-time priority at all.
    runs : how many runs share this machine evenly.
    """

    def __init__(self, realtime: bool = True, runs: int = 1) -> None:
        # Linux only: elsewhere these calls are missing or mean something else.
        self._realtime = realtime and sys.platform == "linux"
        self._most = MOST * _processors() / runs
        self._used: dict[int, float] = {}
        self._since = float("-inf")
        self.how: How = "ordinary"

    def review(self, threads: Collection[threading.Thread]) -> None:
        """Give precedence to these threads, or take it back; takes up to a millisecond twice a second.

        threads : those that work on live frames; ones that have ended are left out.
        """
        now = time.perf_counter()
        if now - self._since < REVIEW_S:
            return
        ids = [t.native_id for t in threads if t.is_alive() and t.native_id is not None]
        used = {id_: _processor_seconds(id_) for id_ in ids}
        # Of a thread that was not there the last time, nothing is known yet.
        spent = sum(seconds - self._used.get(id_, seconds) for id_, seconds in used.items())
        share = spent / (now - self._since)
        new = used.keys() - self._used.keys()
        self._used, self._since = used, now
        if self._realtime and self.how == "real-time" and share > self._most:
            log.warning(
                "live frames take %.1f of %d processors: they lose their real-time priority until it is less",
                share,
                _processors(),
            )
            self._make(ids, "short slices")
        elif self._realtime and self.how != "real-time" and share < AGAIN * self._most:
            self._make(ids, "real-time")
        elif new:
            self._make(sorted(new), self.how)

    def _make(self, ids: Collection[int], how: How) -> None:
        """Have these threads treated like this, or as near to it as is granted."""
        if how == "real-time":
            self._realtime = all(_be_realtime(id_, True) for id_ in ids)
            if self._realtime:
                self.how = how
                log.info("live frames go first: they have real-time priority")
                return
        for id_ in ids:
            _be_realtime(id_, False)
        granted = [serve_soon(id_) for id_ in ids]
        self.how = "short slices" if all(granted) else "ordinary"


def _processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _processor_seconds(thread: int) -> float:
    """Time for which a thread, by its native id, has had a processor, s; 0 if that cannot be told."""
    if sys.platform != "linux":
        return 0.0
    # The clock of a thread, as Linux makes its number of the thread's (clock_gettime(2), CPUCLOCK_PERTHREAD).
    clock = (~thread << 3) | 6
    try:
        return time.clock_gettime(clock)
    except OSError:
        return 0.0


def _be_realtime(thread: int, wanted: bool) -> bool:
    """Give a thread real-time priority, or take it away; returns whether that was done."""
    if sys.platform != "linux":
        return False
    # What the thread starts itself, other programs among them, stays ordinary. Who has no more than the right
    # to this priority cannot take that back.
    policy = (os.SCHED_RR if wanted else os.SCHED_OTHER) | os.SCHED_RESET_ON_FORK
    try:
        if not wanted and os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
            return True
        level = os.sched_get_priority_min(os.SCHED_RR) if wanted else 0
        os.sched_setscheduler(thread, policy, os.sched_param(level))
    except OSError:
        return False
    return True
