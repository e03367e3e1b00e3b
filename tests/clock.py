"""A clock that a test moves by hand, and waiting for what other threads do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

PATIENCE = 300.0
"""How long a test waits for what must happen, s. Nothing depends on its length, which is below `timeout` of
pytest."""
LOOK_SECONDS = 0.005
"""Time between two looks, s."""


class ManualClock:
    """Time passes only where somebody sleeps, and where a test says so: a machine may be as slow as it likes.

    pause : real time that each sleep takes, s, so that other threads get on meanwhile.
    """

    def __init__(self, pause: float = 0.0) -> None:
        self.sleeps: list[float] = []
        self._now = 100.0
        self._pause = pause
        self._lock = threading.Lock()

    def now(self) -> float:
        return self._now

    def unix(self) -> float:
        return 1e9 + self._now

    def advance(self, seconds: float) -> None:
        with self._lock:
            self._now += seconds

    def sleep(self, seconds: float, end: threading.Event) -> bool:
        self.sleeps.append(seconds)
        self.advance(max(seconds, 0.0))
        return end.wait(self._pause) if self._pause else end.is_set()

    def wait(self, seconds: float, changed: threading.Condition) -> None:
        """Time stands still: what is waited for takes as long as it takes."""
        del seconds
        changed.wait(LOOK_SECONDS)


def until(condition: Callable[[], object], what: Callable[[], object] = str) -> None:
    """Wait until a condition holds that other threads or processes bring about.

    what : tells how things stand, for the failure.
    """
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain: {what()}"
        time.sleep(LOOK_SECONDS)
