"""The clock for waiting and measuring time; tests pass one that they advance."""

from __future__ import annotations

import threading
import time


class Clock:
    """The clock of the machine; thread-safe."""

    def now(self) -> float:
        """Monotonic time, s, as in `Frame.captured`; only differences are meaningful."""
        return time.perf_counter()

    def unix(self) -> float:
        """Unix time, s, for messages and for frames of live sources."""
        return time.time()

    def sleep(self, seconds: float, end: threading.Event) -> bool:
        """Sleep until `end` is set, for at most `seconds`; returns whether it is set."""
        return end.wait(seconds) if seconds > 0 else end.is_set()

    def wait(self, seconds: float, changed: threading.Condition) -> None:
        """Wait for a notification of `changed`, which the caller holds, for at most `seconds`."""
        changed.wait(seconds)


SYSTEM = Clock()
"""The default clock."""
