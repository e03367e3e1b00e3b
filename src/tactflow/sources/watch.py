"""Live sources that come and go: noticed, reported, reconnected.

A thread reads all the time and keeps only the newest frame, so that waiting for a frame can be ended at once,
a driver's buffer never goes stale, and a read that hangs is noticed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, FrameReader, log

BLACK_LEVEL = 4.0
"""Mean grey level at and below which a picture counts as black; a lit gel has 30 and more."""
STEADY_SECONDS = 5.0
"""A connection that delivered for so long has proven itself: the next back-off starts small again."""
START_SECONDS = 3.0
"""A device may take so long to its very first frame before that is reported."""
OPENING_SECONDS = 15.0
"""Opening that takes longer hangs; more than what drivers and streams themselves allow."""
MAX_ABANDONED = 4
"""No new attempt while so many threads hang in a driver."""
SETTLE_SECONDS = 0.1
"""Frames so soon after a silence are not passed on: a decoder that gives up lets go of old ones at once."""
POLL_SECONDS = 0.1
"""How often a waiting reader looks for faults."""


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


class Arrival(NamedTuple):
    """A frame of a live source.

    image, t : as from `FrameReader.read`; t grows strictly. seq : index among all frames of the source, those
    that nobody took included. connection : grows by one with each reconnection that delivered. captured :
    `time.perf_counter` when it arrived, s.
    """

    image: BgrImage
    t: float
    seq: int
    connection: int
    captured: float


@runtime_checkable
class LiveReader(Protocol):
    """A source whose frames are numbered where they arrive, and that tells how it is."""

    @property
    def state(self) -> str:
        """`running`, `waiting since ...` or `reconnecting since ...`."""

    @property
    def missed(self) -> int:
        """Good frames that a newer one replaced before they were read."""

    @property
    def reader(self) -> threading.Thread:
        """The thread that frames arrive in; another one after a read that hung."""

    def read_arrival(self) -> Arrival | None:
        """Wait for the newest frame that was not read yet; None at the end and after `stop`."""

    def stop(self) -> None:
        """End a read that waits, at once. From any thread."""


@dataclass(slots=True)
class _Fault:
    kind: str
    what: str
    since: float
    clock: float
    attempts: int = 0
    detail: str = ""
    resumed: float | None = None


class Watched:
    """A live source that is watched, and opened anew when it fails.

    The first opening happens here and must succeed: a wrong address is an error at once, not after a wait.

    Parameters
    ----------
    opener : opens the source; called again for each reconnection, in another thread.
    watch : what counts as a fault.
    name : what the source is called in messages.

    Raises
    ------
    SourceError
        If the source cannot be opened.
    """

    live = True
    total: int | None = None

    def __init__(self, opener: Callable[[], FrameReader], watch: Watch, name: str) -> None:
        self._opener = opener
        self._watch = watch
        self._name = name
        source = opener()
        self.fps: float | None = source.fps
        self.size: tuple[int, int] | None = source.size
        self.description = source.description
        self.missed = 0
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._end: SourceError | bool = False
        self._slot: Arrival | None = None
        self._seq = -1
        self._t = float("-inf")
        self._connection = 0
        self._fault: _Fault | None = None
        self._attempts = 0
        self._retry_at = 0.0
        self._interval = 1.0 / source.fps if source.fps else 0.0
        self._previous: BgrImage | None = None
        self._same_since = self._light_at = 0.0
        self._lit = False
        now = time.perf_counter()
        self._arrived_at = self._good_at = self._steady_since = now
        self._busy_since: float | None = now
        self._opening = False
        self._abandoned: list[threading.Thread] = []
        self._generation = 0
        self.reader = self._start(source)

    # -- the side that takes frames -----------------------------------------------------------------------

    @property
    def state(self) -> str:
        """How the source is: `running`, `waiting since ...` or `reconnecting since ...`."""
        fault = self._fault
        if fault is None:
            return "running"
        word = "reconnecting" if fault.attempts or fault.kind == "gone" else "waiting"
        attempts = f", attempt {fault.attempts}" if fault.attempts else ""
        return f"{word} since {_clock(fault.clock)} ({fault.what}{attempts})"

    def read(self) -> tuple[BgrImage, float] | None:
        """The newest frame that was not read yet, and its time; see `FrameReader.read`."""
        arrival = self.read_arrival()
        return None if arrival is None else (arrival.image, arrival.t)

    def read_arrival(self) -> Arrival | None:
        """Wait for the newest frame that was not read yet; None at the end and after `stop`.

        Raises
        ------
        SourceError
            If there was no good frame for `no_frame_timeout`, or the source failed and is not to be opened
            anew.
        """
        with self._changed:
            while not self._stopped.is_set():
                arrival, self._slot = self._slot, None
                if arrival is not None:
                    return arrival
                if isinstance(self._end, SourceError):
                    raise self._end
                if self._end:
                    return None
                self._look(time.perf_counter())
                if not self._end:
                    self._changed.wait(POLL_SECONDS)
        return None

    def stop(self) -> None:
        """End a read that waits, at once. From any thread."""
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()

    def close(self) -> None:
        """Let go of the source. A read that hangs is given a moment; it lets go when it ends."""
        self.stop()
        if self.reader is not threading.current_thread():
            self.reader.join(self._watch.hang_after)

    def _look(self, now: float) -> None:
        """Notice what no frame can tell: silence, a read that hangs, the end of all patience."""
        watch = self._watch
        usual = START_SECONDS if self._seq < 0 else watch.silent_after
        if self._fault is None and now - self._arrived_at >= max(usual, 3.0 * self._interval):
            self._report("silent", "no frames", self._arrived_at, now)
        if watch.no_frame_timeout and now - self._good_at >= watch.no_frame_timeout:
            self._end = self._gave_up(now)
            return
        limit = OPENING_SECONDS if self._opening else max(watch.hang_after, 4.0 * self._interval)
        if watch.reconnect and self._busy_since is not None and now - self._busy_since >= limit:
            self._abandoned = [thread for thread in self._abandoned if thread.is_alive()]
            if len(self._abandoned) < MAX_ABANDONED:
                self._abandoned.append(self.reader)
                self._generation += 1
                self._note("opening hangs" if self._opening else "reading hangs")
                self.reader = self._start(None)

    def _gave_up(self, now: float) -> SourceError:
        fault = self._fault
        what = fault.what if fault else "no frames"
        detail = f"; the last attempt of {fault.attempts}: {fault.detail}" if fault and fault.attempts else ""
        if fault and not fault.attempts and fault.detail:
            detail = f": {fault.detail}"
        return SourceError(
            f"{self._name}: {what}, no good frame for {now - self._good_at:.1f} s{detail}; "
            "check its cable, power and light and what else may be using it; "
            "no_frame_timeout says how long to wait (0: for ever)"
        )

    # -- the thread that reads ----------------------------------------------------------------------------

    def _start(self, source: FrameReader | None) -> threading.Thread:
        self._busy_since, self._opening = time.perf_counter(), False
        name = f"tactflow-read-{self._name}"
        thread = threading.Thread(target=self._work, args=(self._generation, source), name=name, daemon=True)
        thread.start()
        return thread

    def _work(self, generation: int, source: FrameReader | None) -> None:
        try:
            while self._enter(generation, opening=False):
                if source is None:
                    source = self._connect(generation)
                elif self._step(generation, source):
                    source.close()
                    source = None
        finally:
            if source is not None:
                source.close()

    def _enter(self, generation: int, *, opening: bool) -> bool:
        """Say what is done next; False if this thread is not wanted any more."""
        with self._changed:
            if generation != self._generation or self._stopped.is_set() or self._end:
                return False
            self._busy_since, self._opening = time.perf_counter(), opening
            return True

    def _connect(self, generation: int) -> FrameReader | None:
        """One attempt, when its time has come."""
        with self._changed:
            if generation != self._generation:
                return None
            self._busy_since = None
            wait = self._retry_at - time.perf_counter()
        if self._stopped.wait(max(wait, 0.0)) or not self._enter(generation, opening=True):
            return None
        try:
            source = self._opener()
        except Exception as error:
            self._missed_attempt(generation, self._words(error))
            return None
        if self.size and source.size and source.size != self.size:
            source.close()
            came, was = ("{} x {}".format(*size) for size in (source.size, self.size))
            self._missed_attempt(generation, f"it came back with {came} pixels instead of {was}")
            return None
        self._missed_attempt(generation, "it was opened, but gave no good frame")
        with self._changed:
            self._connection += generation == self._generation
        return source

    def _missed_attempt(self, generation: int, why: str) -> None:
        """Count an attempt, which only a good frame turns into a success."""
        with self._changed:
            if generation != self._generation:
                return
            self._note(why)
            if self._fault is not None:
                self._fault.attempts += 1
            self._back_off()

    def _back_off(self) -> None:
        watch = self._watch
        delay = min(watch.last_retry, watch.first_retry * 2.0 ** min(self._attempts, 30))
        self._attempts += 1
        self._retry_at = time.perf_counter() + delay

    def _step(self, generation: int, source: FrameReader) -> bool:
        """Read one frame; True if the source is to be opened anew."""
        why = "it ended"
        ended: SourceError | bool = True
        try:
            item = source.read()
        except Exception as error:
            item, why = None, self._words(error)
            ended = error if isinstance(error, SourceError) else SourceError(f"{self._name}: {why}")
        now = time.perf_counter()
        with self._changed:
            if generation != self._generation or self._stopped.is_set():
                return True
            if item is not None:
                again = self._take(*item, now)
                self._changed.notify_all()
                return again
            if not self._watch.reconnect:
                if ended is True:
                    log.warning("%s: the stream ended after %d frames", self._name, self._seq + 1)
                self._end = ended
            elif self._fault is None:
                self._report("gone", "gone", self._arrived_at, now, why)
                self._back_off()
            else:
                self._note(why)
            self._changed.notify_all()
            return True

    def _take(self, image: BgrImage, t: float, now: float) -> bool:
        """A frame has arrived; True if it is faulty and the source is to be opened anew."""
        gap = now - self._arrived_at
        if self._seq >= 0 and self._fault is None:
            self._interval += 0.1 * (gap - self._interval)
        elif self._seq >= 0 and self._fault is not None and not self._fault.attempts:
            # Nothing was broken, it is slow: expect that from now on.
            self._interval = max(self._interval, gap)
        self._arrived_at = now
        self._seq += 1
        if self.size is None:
            self.size = (image.shape[1], image.shape[0])
        fault = self._fault_of(image, now)
        if fault is not None:
            kind, what, since = fault
            if self._fault is None and (kind != "black" or now - since >= (self._watch.black_after or 0.0)):
                self._report(kind, what, since, now)
                self._retry_at = now
            return self._fault is not None and self._watch.reconnect and now >= self._retry_at
        if self._fault is not None:
            if self._fault.kind == "silent" and not self._fault.attempts:
                if self._fault.resumed is None:
                    self._fault.resumed = now
                if now - self._fault.resumed < SETTLE_SECONDS:
                    return False
            self._is_back(now)
        self._good_at = now
        self._t = max(t, float(np.nextafter(self._t, np.inf)))
        self.missed += self._slot is not None
        self._slot = Arrival(image, self._t, self._seq, self._connection, now)
        return False

    def _fault_of(self, image: BgrImage, now: float) -> tuple[str, str, float] | None:
        """What is wrong with the picture: kind, words, since when; None if nothing is."""
        watch = self._watch
        if watch.black_after is not None:
            if float(image[::8, ::8].mean()) > BLACK_LEVEL:
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

    # -- words --------------------------------------------------------------------------------------------

    def _report(self, kind: str, what: str, since: float, now: float, why: str = "") -> None:
        fault = _Fault(kind, what, since, time.time() - (now - since), detail=why)
        self._fault = fault
        if now - self._steady_since >= STEADY_SECONDS:
            self._attempts = 0
        says = {
            "silent": "delivers no frames",
            "gone": "is gone",
            "black": "delivers only black pictures, which are not passed on,",
            "frozen": "delivers the same picture bit for bit, which is not passed on,",
        }[kind]
        then = "" if not self._watch.reconnect else "; waiting" if kind == "silent" else "; reconnecting"
        because = f": {why}" if why else ""
        log.warning(
            "%s: %s since %s (%.1f s)%s%s", self._name, says, _clock(fault.clock), now - since, because, then
        )

    def _is_back(self, now: float) -> None:
        fault = self._fault
        assert fault is not None
        self._fault = None
        self._steady_since = now
        tries = f" and {fault.attempts} attempt{'s'[: fault.attempts > 1]}" if fault.attempts else ""
        log.warning("%s: is back after %.1f s%s (%s)", self._name, now - fault.since, tries, fault.what)

    def _note(self, why: str) -> None:
        if self._fault is not None:
            self._fault.detail = why
        log.debug("%s: %s", self._name, why)

    def _words(self, error: Exception) -> str:
        text = str(error).removeprefix(f"{self._name}: ")
        return text if isinstance(error, SourceError) else f"{type(error).__name__}: {text}"


def _equal(a: BgrImage, b: BgrImage) -> bool:
    """Whether two pictures are the same bit for bit; noise is found in the first few rows compared."""
    return a.shape == b.shape and np.array_equal(a[::64], b[::64]) and np.array_equal(a, b)


def _clock(unix: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(unix))
