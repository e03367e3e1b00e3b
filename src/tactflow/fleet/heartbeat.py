"""Signs of life: a sensor's process touches a file every second, and its supervisor watches that file.

A process that hangs is one that does not touch it: it was stopped, it waits for a lock that nobody opens, or
one of its stages has been at the same frame all the time. One that waits for frames, or for somebody to take
its results, touches it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from tactflow.system.files import status

BEAT_EVERY = 1.0
"""Time between two signs of life, s. Chosen by hand."""
HANG_AFTER = 60.0
"""A process without a sign of life for so long, s, hangs. Chosen by hand: to start takes a few seconds, ten
on a machine with other work; one frame in a slow stage takes a second."""
LONGEST_LOOK = 1.0
"""Time between two looks counts as no longer than this, s: while the supervisor itself was stopped, it has
missed signs of life. Chosen by hand."""


class Headway:
    """Tells whether every thread has got on since that was last so.

    calls : thread -> number of the call that it is in; one that waits is left out.

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
        """Whether no call that is under way was under way the last time that the answer was yes."""
        now = self._calls()
        gets_on = self._before.items().isdisjoint(now.items())
        if gets_on:
            self._before = now
        return gets_on


def start_beating(path: Path, headway: Callable[[], bool]) -> None:
    """Touch a file every second from now on, if there is headway."""
    threading.Thread(target=_beat, args=(path, headway), name="tactflow-heartbeat", daemon=True).start()


def _beat(path: Path, headway: Callable[[], bool]) -> None:
    pause = threading.Event()
    while not pause.wait(BEAT_EVERY):
        if headway():
            with suppress(OSError):
                path.touch()


class SignOfLife:
    """How long a process has been silent, as its supervisor sees it.

    path : the file that it touches. limit : how long it may be silent, s; while it starts, no less than
    `HANG_AFTER`. silent : how long it has been, s.
    """

    def __init__(self, path: Path, limit: float = HANG_AFTER) -> None:
        self.path = path
        self.silent = 0.0
        self._limit = limit
        self._heard = False
        self._looked = 0.0
        self._touched: int | None = None

    def start(self, now: float) -> None:
        """A new process has just been started, at a time in seconds."""
        self.silent = 0.0
        self._looked = now
        self._heard = False

    @property
    def limit(self) -> float:
        """How long the process may be silent now, s."""
        return self._limit if self._heard else max(self._limit, HANG_AFTER)

    def look(self, now: float) -> bool:
        """Look whether there was a sign since the last look; whether the silence is too long."""
        there = status(str(self.path))
        touched = None if there is None else there.st_mtime_ns
        self.silent += min(now - self._looked, LONGEST_LOOK)
        self._looked = now
        if touched != self._touched:
            self._touched, self.silent, self._heard = touched, 0.0, True
        return self.silent > self.limit

    def excuse(self, now: float) -> None:
        """The time since the last look does not count."""
        self._looked = now
