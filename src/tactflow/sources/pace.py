"""Playing a recording at its own pace."""

from __future__ import annotations

import threading
import time

MAX_BACKLOG = 0.5
"""A recording that falls further behind than this, s, continues from there: a laptop was asleep, or the
process was halted, and rushing through what was missed would help nobody."""


class Pace:
    """Waits until a recording's frames are due, counted from the first one, so that delays do not add up.

    Parameters
    ----------
    stop : ends every wait at once.
    """

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self._start: float | None = None

    def wait_for(self, t: float) -> bool:
        """Wait until time t of the recording, s; False if stopped meanwhile."""
        now = time.perf_counter()
        if self._start is None:
            self._start = now - t
        wait = self._start + t - now
        if wait < -MAX_BACKLOG:
            self._start = now - t
        return not (self._stop.wait(wait) if wait > 0 else self._stop.is_set())
