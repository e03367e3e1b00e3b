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
LONGEST_LOOK = 1.0
"""Longest time counted between two polls, s: a supervisor that was stopped itself has missed heartbeats."""


class Headway:
    """Tells whether every thread has made progress since the last time that all had.

    calls : returns thread -> number of its current call; waiting threads are left out.

    >>> numbers = {"compute": 1}
    >>> headway = Headway(lambda: dict(numbers))
    >>> headway(), headway()
    (True, False)
    >>> numbers["compute"] += 1
    >>> headway()
    True
    """

    def __init__(self, calls: Callable[[], Mapping[str, int]]) -> None:
        self._calls = calls
        self._before: Mapping[str, int] = {}

    def __call__(self) -> bool:
        """Whether no current call was already running when the answer was last yes."""
        now = self._calls()
        gets_on = self._before.items().isdisjoint(now.items())
        if gets_on:
            self._before = now
        return gets_on


def start_beating(path: Path, headway: Callable[[], bool]) -> None:
    """Touch a file every second from now on while there is progress."""
    threading.Thread(target=_beat, args=(path, headway), name="tactflow-heartbeat", daemon=True).start()


def _beat(path: Path, headway: Callable[[], bool]) -> None:
    pause = threading.Event()
    while not pause.wait(BEAT_EVERY):
        if headway():
            with suppress(OSError):
                path.touch()


class SignOfLife:
    """How long a process has been silent, from its supervisor's view.

    path : the file that the process touches. limit : longest silence, s; at least `HANG_AFTER` while it
    starts. silent : time since the last heartbeat, s.
    """

    def __init__(self, path: Path, limit: float = HANG_AFTER) -> None:
        self.path = path
        self.silent = 0.0
        self._limit = limit
        self._heard = False
        self._looked = 0.0
        self._touched: int | None = None

    def start(self, now: float) -> None:
        """Begin to watch a process started at time `now`, s."""
        self.silent = 0.0
        self._looked = now
        self._heard = False

    @property
    def limit(self) -> float:
        """Longest silence that is accepted now, s."""
        return self._limit if self._heard else max(self._limit, HANG_AFTER)

    def look(self, now: float) -> bool:
        """Check for a heartbeat; returns whether the silence is too long."""
        there = status(str(self.path))
        touched = None if there is None else there.st_mtime_ns
        self.silent += min(now - self._looked, LONGEST_LOOK)
        self._looked = now
        if touched != self._touched:
            self._touched, self.silent, self._heard = touched, 0.0, True
        return self.silent > self.limit

    def excuse(self, now: float) -> None:
        """Do not count the time since the last check."""
        self._looked = now
