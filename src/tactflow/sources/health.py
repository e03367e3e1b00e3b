"""How a live source is: what counts as a fault, since when, and when to try again.

No thread, no device and no clock here: whoever watches a source says what happened and when.
"""

from __future__ import annotations

import enum
import logging
import time
from dataclasses import dataclass

import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage
from tactflow.system.clock import SYSTEM, Clock

log = logging.getLogger("tactflow")

BLACK_LEVEL = 4.0
"""Mean grey level at and below which a picture counts as black; a lit gel has 30 and more."""
BLACK_STEP = 8
"""The mean is taken over one row and column in so many: a mean needs no more pixels. Chosen by hand, px."""
STEADY_SECONDS = 5.0
"""A connection that delivered for so long has proven itself: the next back-off starts small again.
Chosen by hand, s."""
START_SECONDS = 3.0
"""A device may take so long to its very first frame before that is reported. Chosen by hand, s."""
SETTLE_SECONDS = 0.1
"""Frames so soon after a silence are not passed on: a decoder that gives up lets go of old ones at once.
Chosen by hand, s."""
SILENT_INTERVALS = 3.0
"""Times the usual time between frames: a shorter gap is no silence. Chosen by hand."""
HANG_INTERVALS = 4.0
"""Times the usual time between frames: a shorter read does not hang. More than `SILENT_INTERVALS`, so that
silence is reported before anything is done about it. Chosen by hand."""
INTERVAL_GAIN = 0.1
"""Weight of the newest gap in the running mean of the time between frames. Chosen by hand."""
MOST_DOUBLINGS = 30
"""The time between attempts is not doubled more often, which would only overflow."""
COMPARED_STEP = 64
"""Pictures are compared in one row of so many first: noise shows there already. Chosen by hand, px."""


@dataclass(frozen=True, slots=True)
class Watch:
    """What counts as a fault of a live source, and what is done then. All times in s.

    reconnect : open the source anew after a fault, until it is back. If False, a camera that stops is an
        error and a stream that ends is the end.
    no_frame_timeout : an error after so long without a good frame; None or 0 never gives up.
    frozen_after : pictures that are the same bit for bit for so long are a fault; None never.
    black_after : black pictures for so long are a fault; None never.
    silent_after : no picture at all for so long, and for three times the usual interval, is a fault.
    hang_after : a read that takes longer is left to itself, and the source is opened anew.
    first_retry, last_retry : time between attempts: doubles from the first to the last.
    """

    reconnect: bool = True
    no_frame_timeout: float | None = 30.0
    frozen_after: float | None = 3.0
    black_after: float | None = 1.0
    silent_after: float = 0.8
    hang_after: float = 3.0
    first_retry: float = 0.25
    last_retry: float = 2.0


class Verdict(enum.Enum):
    """What is to be done after a frame: pass it on, hold it back, or open the source anew."""

    GOOD = enum.auto()
    WITHHOLD = enum.auto()
    REOPEN = enum.auto()


@dataclass(slots=True)
class _Fault:
    """kind : silent, gone, black or frozen. since : on the clock, s. unix : the same as Unix time, s.

    attempts : to open the source anew. detail : what the last one said. resumed : when frames came again.
    """

    kind: str
    what: str
    since: float
    unix: float
    attempts: int = 0
    detail: str = ""
    resumed: float | None = None


_SAYS = {
    "silent": "delivers no frames",
    "gone": "is gone",
    "black": "delivers only black pictures, which are not passed on,",
    "frozen": "delivers the same picture bit for bit, which is not passed on,",
}


class Health:
    """What is known of a live source, from the frames that came and those that did not.

    Not safe for several threads at once: its owner holds a lock.

    Parameters
    ----------
    watch : what counts as a fault.
    name : what the source is called in messages.
    fps : frames per second that the source promises, or None.
    clock : tells what time it was on the wall when a fault began.
    """

    def __init__(self, watch: Watch, name: str, fps: float | None = None, clock: Clock = SYSTEM) -> None:
        self.interval = 1.0 / fps if fps else 0.0
        """Usual time between frames, s; 0 while nothing is known."""
        self.retry_at = 0.0
        """When the source may be opened again, s."""
        self._watch = watch
        self._name = name
        self._clock = clock
        self._fault: _Fault | None = None
        self._frames = 0
        self._attempts = 0
        self._previous: BgrImage | None = None
        self._same_since = self._light_at = 0.0
        self._lit = False
        self._arrived_at = self._good_at = self._steady_since = clock.now()

    @property
    def state(self) -> str:
        """How the source is: `running`, `waiting since ...` or `reconnecting since ...`."""
        fault = self._fault
        if fault is None:
            return "running"
        word = "reconnecting" if fault.attempts or fault.kind == "gone" else "waiting"
        attempts = f", attempt {fault.attempts}" if fault.attempts else ""
        return f"{word} since {_hour(fault.unix)} ({fault.what}{attempts})"

    def frame(self, image: BgrImage, now: float) -> Verdict:
        """A frame has arrived."""
        self._expect(now - self._arrived_at)
        self._arrived_at = now
        self._frames += 1
        found = self._fault_of(image, now)
        if found is not None:
            kind, what, since = found
            if self._fault is None and (kind != "black" or now - since >= (self._watch.black_after or 0.0)):
                self._report(kind, what, since, now)
                self.retry_at = now
            reopen = self._fault is not None and self._watch.reconnect and now >= self.retry_at
            return Verdict.REOPEN if reopen else Verdict.WITHHOLD
        fault = self._fault
        if fault is not None:
            if fault.kind == "silent" and not fault.attempts:
                if fault.resumed is None:
                    fault.resumed = now
                if now - fault.resumed < SETTLE_SECONDS:
                    return Verdict.WITHHOLD
            self._is_back(fault, now)
        self._good_at = now
        return Verdict.GOOD

    def look(self, now: float) -> None:
        """Notice what no frame can tell: silence."""
        usual = START_SECONDS if self._frames == 0 else self._watch.silent_after
        if self._fault is None and now - self._arrived_at >= max(usual, SILENT_INTERVALS * self.interval):
            self._report("silent", "no frames", self._arrived_at, now)

    def given_up(self, now: float) -> SourceError | None:
        """The error that ends the source, once there was no good frame for `no_frame_timeout`."""
        watch, fault = self._watch, self._fault
        if not watch.no_frame_timeout or now - self._good_at < watch.no_frame_timeout:
            return None
        what = fault.what if fault else "no frames"
        detail = ""
        if fault and fault.attempts:
            detail = f"; the last attempt of {fault.attempts}: {fault.detail}"
        elif fault and fault.detail:
            detail = f": {fault.detail}"
        return SourceError(
            f"{self._name}: {what}, no good frame for {now - self._good_at:.1f} s{detail}; "
            "check its cable, power and light and what else may be using it; "
            "no_frame_timeout says how long to wait (0: for ever)"
        )

    def ended(self, why: str, now: float) -> None:
        """Reading failed or said that it is the end; the source is to be opened anew."""
        if self._fault is None:
            self._report("gone", "gone", self._arrived_at, now, why)
            self._back_off(now)
        else:
            self.note(why)

    def missed_attempt(self, why: str, now: float) -> None:
        """Count an attempt to open the source, which only a good frame turns into a success."""
        self.note(why)
        if self._fault is not None:
            self._fault.attempts += 1
        self._back_off(now)

    def note(self, why: str) -> None:
        """Remember what was said last, for the error that may follow."""
        if self._fault is not None:
            self._fault.detail = why
        log.debug("%s: %s", self._name, why)

    def _expect(self, gap: float) -> None:
        """Learn the usual time between frames from the newest gap, s."""
        if self._frames == 0:
            return
        if self._fault is None:
            self.interval += INTERVAL_GAIN * (gap - self.interval)
        elif not self._fault.attempts:
            # Nothing was broken, it is slow: expect that from now on.
            self.interval = max(self.interval, gap)

    def _fault_of(self, image: BgrImage, now: float) -> tuple[str, str, float] | None:
        """What is wrong with the picture: kind, words, since when; None if nothing is."""
        watch = self._watch
        if watch.black_after is not None:
            if float(image[::BLACK_STEP, ::BLACK_STEP].mean()) > BLACK_LEVEL:
                self._light_at, self._lit = now, True
            elif not self._lit or now - self._light_at >= watch.black_after:
                # Before anything was seen, black is no picture of the gel: it must not become the reference.
                self._light_at = self._light_at or now
                return "black", "black pictures", self._light_at
        if watch.frozen_after is not None:
            if self._previous is None or not _equal(image, self._previous):
                self._previous, self._same_since = image, now
            elif self._fault is not None and self._fault.kind != "frozen":
                # What was not there could not move.
                self._same_since = now
            elif now - self._same_since >= watch.frozen_after:
                return "frozen", "a frozen picture", self._same_since
        return None

    def _back_off(self, now: float) -> None:
        watch = self._watch
        delay = min(watch.last_retry, watch.first_retry * 2.0 ** min(self._attempts, MOST_DOUBLINGS))
        self._attempts += 1
        self.retry_at = now + delay

    def _report(self, kind: str, what: str, since: float, now: float, why: str = "") -> None:
        fault = _Fault(kind, what, since, self._clock.unix() - (now - since), detail=why)
        self._fault = fault
        if now - self._steady_since >= STEADY_SECONDS:
            self._attempts = 0
        then = "" if not self._watch.reconnect else "; waiting" if kind == "silent" else "; reconnecting"
        because = f": {why}" if why else ""
        log.warning(
            *("%s: %s since %s (%.1f s)%s%s", self._name, _SAYS[kind], _hour(fault.unix), now - since),
            *(because, then),
        )

    def _is_back(self, fault: _Fault, now: float) -> None:
        self._fault = None
        self._steady_since = now
        tries = f" and {fault.attempts} attempt{'s'[: fault.attempts > 1]}" if fault.attempts else ""
        log.warning("%s: is back after %.1f s%s (%s)", self._name, now - fault.since, tries, fault.what)


def _equal(a: BgrImage, b: BgrImage) -> bool:
    """Whether two pictures are the same bit for bit; noise is found in the first few rows compared."""
    return (
        a.shape == b.shape and np.array_equal(a[::COMPARED_STEP], b[::COMPARED_STEP]) and np.array_equal(a, b)
    )


def _hour(unix: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(unix))
