"""Playing a recording in real time."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator

from tactflow.sources.base import Arrival
from tactflow.system.clock import SYSTEM, Clock

READ_DELAY_FRACTION = 0.5
"""Fraction of the time between frames after which the next one is read: reading, unpacking or rendering it
earlier would compete with the processing of the last one. Chosen by hand."""
MAX_BACKLOG_S = 0.5
"""Delay after which the recording does not catch up but continues from there, s. Chosen by hand."""
MAX_GAP_S = 60.0
"""Longest gap that is waited for, s; longer ones are skipped. Chosen by hand."""

logger = logging.getLogger("tactflow")


class Pace:
    """Waits until frames are due, relative to the first one, so that delays do not accumulate.

    Parameters
    ----------
    stop : ends waiting immediately.
    clock : for time and waiting.

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
        """Wait until the next frame should be read; False if stopped."""
        if self._start is None or self._interval == math.inf:
            return not self._stop.is_set()
        due = self._start + self._last + READ_DELAY_FRACTION * self._interval
        return not self._clock.sleep(max(due - self._clock.now(), 0.0), self._stop)

    def wait_for(self, t: float) -> bool:
        """Wait until time t of the recording, s; False if stopped. Skips gaps of a minute."""
        now = self._clock.now()
        if self._start is not None and t - self._last > MAX_GAP_S:
            logger.warning("the recording pauses for %.3g s, which is skipped", t - self._last)
            self._start = now - t
        elif self._start is None or self._start + t - now < -MAX_BACKLOG_S:
            self._start = now - t
        elif t > self._last:
            # The shortest so far, because dropped frames leave gaps.
            self._interval = min(self._interval, t - self._last)
        self._last = t
        return not self._clock.sleep(max(self._start + t - now, 0.0), self._stop)


def paced(arrivals: Iterator[Arrival], name: str, realtime: bool, stop: threading.Event) -> Iterator[Arrival]:
    """Frames of a source until its end or `stop`, with non-decreasing times.

    If times decrease, they continue from the last one, with a warning. name : of the source, for messages.
    realtime : yield each frame when it is due; else immediately.
    """
    pace = Pace(stop) if realtime else None
    latest, ahead = -math.inf, 0.0
    while not stop.is_set() and (pace is None or pace.wait_to_read()):
        arrival = next(arrivals, None)
        if arrival is None:
            return
        t = arrival.t + ahead
        if arrival.paced:
            if t < latest:
                if ahead == 0:
                    text = "%s: its times run back by %.3g s; they are counted on from there"
                    logger.warning(text, name, latest - t)
                ahead, t = ahead + latest - t, latest
            latest = t
            if pace is not None and not pace.wait_for(t):
                return
        yield arrival if ahead == 0 else arrival._replace(t=t)
