"""Time and pauses, as what waits is given them: the system's, or in tests a clock that is moved by hand.

>>> from threading import Event
>>> from tactflow.system.clock import SYSTEM
>>> began = SYSTEM.now()
>>> SYSTEM.sleep(0.001, Event())
False
>>> SYSTEM.now() > began
True
"""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """What tells the time and lets it pass. Its methods may be called from any thread."""

    def now(self) -> float:
        """Monotonic time, s; only differences mean something."""

    def unix(self) -> float:
        """Time since 1970, s, for people and for frames of live sources."""

    def sleep(self, seconds: float, end: threading.Event) -> bool:
        """Let time pass, at most until `end` is set; whether it is."""

    def wait(self, seconds: float, changed: threading.Condition) -> None:
        """Wait for another thread to notify `changed`, which the caller holds, at most `seconds`."""


class SystemClock:
    """The clock of the machine. `now` is `time.perf_counter`, as in `Frame.captured`."""

    def now(self) -> float:
        """Monotonic time, s."""
        return time.perf_counter()

    def unix(self) -> float:
        """Time since 1970, s."""
        return time.time()

    def sleep(self, seconds: float, end: threading.Event) -> bool:
        """Sleep, at most until `end` is set; whether it is."""
        return end.wait(seconds) if seconds > 0 else end.is_set()

    def wait(self, seconds: float, changed: threading.Condition) -> None:
        """Wait until notified, but no longer than `seconds`."""
        changed.wait(seconds)


SYSTEM = SystemClock()
"""The clock that everything uses unless it is given another one."""
