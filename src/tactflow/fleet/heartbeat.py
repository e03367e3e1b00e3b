"""Heartbeats: a sensor's process touches a file every second, and its supervisor watches that file.

A process hangs if it stops touching the file: it was stopped, is deadlocked, or one of its stages does not
finish a frame. Waiting for frames, or for readers of its results, is not hanging.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from tactflow.system.files import status

BEAT_EVERY = 1.0
"""Interval of the heartbeat, s."""
HANG_AFTER = 60.0
"""Time without a heartbeat, s, after which a process hangs. To start takes a few seconds, ten on a busy
machine; a frame in a slow stage takes a second."""
MAX_INTERVAL = 1.0
"""Longest time counted between two checks, s: a supervisor that was stopped itself has missed heartbeats."""


def progress_of(calls: Callable[[], Mapping[str, int]]) -> Callable[[], bool]:
    """Whether every thread has made progress since the last time that all had, as a function.

    calls : returns thread -> number of its current call; waiting threads are left out.

    >>> numbers = {"compute": 1}
    >>> progress = progress_of(lambda: dict(numbers))
    >>> progress(), progress()
    (True, False)
    >>> numbers["compute"] += 1
    >>> progress()
    True
    """
    before: Mapping[str, int] = {}

    def progress() -> bool:
        nonlocal before
        now = calls()
        advanced = before.items().isdisjoint(now.items())
        if advanced:
            before = now
        return advanced

    return progress


def start_heartbeat(path: Path, progress: Callable[[], bool]) -> None:
    """Touch a file every second from now on while there is progress."""

    def beat() -> None:
        pause = threading.Event()
        while not pause.wait(BEAT_EVERY):
            if progress():
                with suppress(OSError):
                    path.touch()

    threading.Thread(target=beat, name="tactflow-heartbeat", daemon=True).start()


class Watchdog:
    """Watches the heartbeat of a process.

    path : the file that the process touches. timeout : longest silence, s; at least `HANG_AFTER` until the
    first heartbeat. silent : time since the last heartbeat, s.
    """

    def __init__(self, path: Path, timeout: float = HANG_AFTER) -> None:
        self.path = path
        self.silent = 0.0
        self._timeout = timeout
        self._started = False
        self._checked = 0.0
        self._touched: int | None = None

    def start(self, now: float) -> None:
        """Begin to watch a process started at time `now`, s."""
        self.silent, self._checked, self._started = 0.0, now, False

    @property
    def timeout(self) -> float:
        """Longest silence that is accepted now, s."""
        return self._timeout if self._started else max(self._timeout, HANG_AFTER)

    def expired(self, now: float, *, blocked: bool = False) -> bool:
        """Check for a heartbeat; returns whether the silence is too long.

        blocked : the process may wait for its supervisor, so the time since the last check does not count.
        """
        file = status(str(self.path))
        touched = None if file is None else file.st_mtime_ns
        self.silent += 0.0 if blocked else min(now - self._checked, MAX_INTERVAL)
        self._checked = now
        if touched != self._touched:
            self._touched, self.silent, self._started = touched, 0.0, True
        return self.silent > self.timeout
