"""Playing a recording at its own pace."""

from __future__ import annotations

import math
import threading

from tactflow.system.clock import SYSTEM, Clock

LEAD = 1.25
"""Times as long as reading a frame took of late is set aside for reading the next. Chosen by hand."""
SPARE = 0.001
"""Time that is set aside beside that: what it takes to wake up. Chosen by hand, s."""
FORGET = 0.9
"""What is left of a slow read after each frame, as a factor. Chosen by hand."""

GRACE = 0.2
"""Part of the time between frames for which the next one is not read, even if reading is late: else one late
frame makes all that follow late. Chosen by hand."""

MAX_BACKLOG = 0.5
"""A recording that falls further behind than this, s, continues from there: a laptop was asleep, or the
process was halted, and rushing through what was missed would help nobody. Chosen by hand."""


class Pace:
    """Waits until a recording's frames are due, counted from the first one, so that delays do not add up.

    Frames are read just in time: what reads, unpacks or renders the next one right after handing over the
    last takes the processor from the work on that one, which no camera does.

    Parameters
    ----------
    stop : ends every wait at once.
    clock : tells the time, and lets it pass.

    Examples
    --------
    >>> from threading import Event
    >>> pace = Pace(Event())
    >>> pace.wait_to_read(), pace.wait_for(0.0)
    (True, True)
    """

    def __init__(self, stop: threading.Event, clock: Clock = SYSTEM) -> None:
        self._stop = stop
        self._clock = clock
        self._start: float | None = None
        self._last: float | None = None
        self._interval = math.inf
        self._slowest = 0.0
        self._reading: float | None = None

    def wait_to_read(self) -> bool:
        """Wait until it is time to read the next frame; False if stopped meanwhile."""
        now = self._clock.now()
        wait = 0.0
        if self._start is not None and self._last is not None and self._interval < math.inf:
            due = self._start + self._last + self._interval
            rest = min(GRACE * self._interval, (self._interval - self._slowest) / 2)
            wait = max(due - LEAD * self._slowest - SPARE - now, rest)
        if wait > 0 and self._clock.sleep(wait, self._stop):
            return False
        self._reading = self._clock.now()
        return not self._stop.is_set()

    def wait_for(self, t: float) -> bool:
        """Wait until time t of the recording, s; False if stopped meanwhile."""
        now = self._clock.now()
        if self._reading is not None:
            self._slowest = max(now - self._reading, FORGET * self._slowest)
            self._reading = None
        if self._start is None:
            self._start = now - t
        if self._last is not None:
            # The shortest so far: behind a gap, where frames were dropped, the next one is not late.
            self._interval = min(self._interval, max(0.0, t - self._last))
        self._last = t
        wait = self._start + t - now
        if wait < -MAX_BACKLOG:
            self._start = now - t
        return not self._clock.sleep(max(wait, 0.0), self._stop)
