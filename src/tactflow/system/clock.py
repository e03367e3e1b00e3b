"""The clock of everything that waits or measures time; a test passes one that it moves by hand.

>>> from tactflow.system.clock import SYSTEM
>>> began = SYSTEM.now()
>>> SYSTEM.sleep(0.001, threading.Event())
False
>>> SYSTEM.now() > began
True
"""

from __future__ import annotations

import threading
import time


class Clock:
    """The clock of the machine. Its methods may be called from any thread."""

    def now(self) -> float:
        """Monotonic time, s, as in `Frame.captured`; only differences mean something."""
        return time.perf_counter()

    def unix(self) -> float:
        """Time since 1970, s, for people and for frames of live sources."""
        return time.time()

    def sleep(self, seconds: float, end: threading.Event) -> bool:
        """Sleep, at most until `end` is set; returns whether it is."""
        return end.wait(seconds) if seconds > 0 else end.is_set()

    def wait(self, seconds: float, changed: threading.Condition) -> None:
        """Wait until another thread notifies `changed`, which the caller holds, at most `seconds`."""
        changed.wait(seconds)


SYSTEM = Clock()
"""The clock that everything uses unless it is given another one."""
