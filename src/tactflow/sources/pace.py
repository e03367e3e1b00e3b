"""Playing a recording at its own pace."""

from __future__ import annotations

import logging
import math
import threading

from tactflow.system.clock import SYSTEM, Clock

REST = 0.5
"""The next frame is read after this fraction of the time between frames: what reads, unpacks or renders it
earlier takes the processor from the work on the last one, which no camera does. Chosen by hand."""
MAX_BACKLOG = 0.5
"""A recording that falls further behind than this, s, continues from there: a laptop was asleep, or the
process was halted, and rushing through what was missed would help nobody. Chosen by hand."""
LONGEST_GAP = 60.0
"""A recording that pauses for longer, s, is continued at once: nobody waits for a wrong clock. Chosen by
hand."""

logger = logging.getLogger("tactflow")


class Pace:
    """Waits until a recording's frames are due, counted from the first one, so that delays do not add up.

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
        self._last = 0.0
        self._interval = math.inf

    def wait_to_read(self) -> bool:
        """Wait until it is time to read the next frame; False if stopped meanwhile."""
        if self._start is None or self._interval == math.inf:
            return not self._stop.is_set()
        due = self._start + self._last + REST * self._interval
        return not self._clock.sleep(max(due - self._clock.now(), 0.0), self._stop)

    def wait_for(self, t: float) -> bool:
        """Wait until time t of the recording, s; False if stopped meanwhile. Skips gaps of a minute."""
        now = self._clock.now()
        if self._start is not None and t - self._last > LONGEST_GAP:
            logger.warning("the recording pauses for %.3g s, which is skipped", t - self._last)
            self._start = now - t
        elif self._start is None or self._start + t - now < -MAX_BACKLOG:
            self._start = now - t
        elif t > self._last:
            # The shortest so far: after a gap, where frames were dropped, the next one is not late.
            self._interval = min(self._interval, t - self._last)
        self._last = t
        return not self._clock.sleep(max(self._start + t - now, 0.0), self._stop)
