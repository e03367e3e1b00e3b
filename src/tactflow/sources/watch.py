"""Monitoring of live sources: faults are reported, and the source is reopened.

A thread reads continuously and keeps only the newest frame, so that the driver's buffer holds no old frames,
and waiting for a frame can be interrupted.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.sources.base import Arrival, FrameReader, log
from tactflow.system.clock import SYSTEM, Clock
from tactflow.vision.arrays import ColorImage

MAX_BLACK_MEAN_GREY = 4.0
"""Maximum mean gray level of a black picture; a lit gel has 30 and more."""
SAMPLING_STEP_PX = 8
"""Sampling step for that mean, px. Chosen by hand."""
FIRST_FRAME_SECONDS = 3.0
"""Stall timeout for the first frame, s. Chosen by hand."""
MIN_STALL_FRAMES = 3.0
"""Minimum stall timeout of a slow camera, frames. Chosen by hand."""
CLOSE_SECONDS = 3.0
"""Longest time that `close` waits for a pending read, s. Chosen by hand."""
POLL_SECONDS = 0.1
"""Interval at which a waiting reader checks for faults, s. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Watch:
    """Faults of a live source, and their handling. All times in s.

    Attributes
    ----------
    reconnect : reopen the source after a fault. If False, a camera that stops is an error, and the end of a
        stream is the end of the source.
    no_frame_timeout : time without a good frame after which reading fails; None or 0: never.
    frozen_after : time with identical pictures that is a fault; None: never.
    black_after : time with black pictures that is a fault; None: never.
    silent_after : stall timeout: time without a picture that is a fault, if it is longer than three frames.
    retry : time between attempts to reopen the source.
    """

    reconnect: bool = True
    no_frame_timeout: float | None = 30.0
    frozen_after: float | None = 3.0
    black_after: float | None = 1.0
    silent_after: float = 1.5
    retry: float = 0.5


@dataclass(slots=True)
class _Fault:
    """A fault of a source that lasts.

    Attributes
    ----------
    kind : in words.
    since : time of the clock, s.
    hour : the same as text.
    retry_at : time of the next attempt to open the source, s.
    detail : the last error.
    attempts : number so far.
    """

    kind: str
    since: float
    hour: str
    retry_at: float
    detail: str = ""
    attempts: int = 0


class Watched(FrameReader):
    """A monitored live source, which is reopened when it fails.

    The constructor opens it and must succeed, so that a wrong address is an error immediately.

    Raises SourceError if the source cannot be opened, and from `read` if there was no good frame for
    `no_frame_timeout`, or the source failed and `reconnect` is False. Any reader can replace a camera:

    Parameters
    ----------
    opener : opens the source; also called for each reconnection, in another thread.
    name : for messages.
    clock : for time, and for waiting between attempts.

    Examples
    --------
    >>> from tactflow.sources import open_source
    >>> source = Watched(lambda: open_source("sim:idle?frames=100"), Watch(), "example")
    >>> image, t = source.read()
    >>> image.shape, source.state
    ((600, 800, 3), 'running')
    >>> source.close()
    """

    live = True

    def __init__(
        self, opener: Callable[[], FrameReader], watch: Watch, name: str, clock: Clock = SYSTEM
    ) -> None:
        super().__init__(name)
        self._arrivals = iter(self._next_arrival, None)
        self._opener = opener
        self._watch = watch
        self._clock = clock
        source = opener()
        self.fps, self.size, self.description = source.fps, source.size, source.description
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._ended = False
        self._failure: Exception | None = None
        self._newest: Arrival | None = None
        self._seq, self._t = -1, -math.inf
        self._fault: _Fault | None = None
        self._arrived_at = self._good_at = self._lit_at = self._changed_at = clock.now()
        self._lit = False
        self._previous: ColorImage | None = None
        self._reader = threading.Thread(
            target=self._work, args=(source,), name=f"tactflow-read-{name}", daemon=True
        )
        self._reader.start()

    @property
    def state(self) -> str:  # type: ignore[override]
        """The current fault and its start."""
        fault = self._fault
        if fault is None:
            return "running"
        attempts = f", attempt {fault.attempts}" if fault.attempts else ""
        word = "reconnecting" if fault.attempts or fault.kind == "gone" else "waiting"
        return f"{word} since {fault.hour} ({fault.kind}{attempts})"

    def _next_arrival(self) -> Arrival | None:
        """Wait for a new frame, and return the newest; None at the end and after `stop`."""
        with self._changed:
            while not self._stopped.is_set():
                arrival, self._newest = self._newest, None
                if arrival is not None:
                    return arrival
                if self._failure is not None:
                    raise self._failure
                if self._ended:
                    return None
                self._check_time(self._clock.now())
                if self._failure is None:
                    self._clock.wait(POLL_SECONDS, self._changed)
        return None

    def stop(self) -> None:
        """End a waiting read immediately. Thread-safe."""
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()

    def close(self) -> None:
        """Release the source; a hanging read releases it when it ends."""
        super().close()
        self.stop()
        self._reader.join(CLOSE_SECONDS)

    # -- faults; callers hold the lock --------------------------------------------------------------------

    def _check_time(self, now: float) -> None:
        """Detect stalls and timeouts."""
        watch = self._watch
        usual = MIN_STALL_FRAMES / self.fps if self.fps else 0.0
        longest = max(FIRST_FRAME_SECONDS if self._seq < 0 else 0.0, watch.silent_after, usual)
        if self._fault is None and now - self._arrived_at >= longest:
            self._report("no frames", self._arrived_at, now)
        if watch.no_frame_timeout and now - self._good_at >= watch.no_frame_timeout:
            self._failure = self._timeout_error(now)

    def _timeout_error(self, now: float) -> SourceError:
        fault = self._fault
        last = f"; the last attempt of {fault.attempts}" if fault and fault.attempts else ""
        detail = f"{last}: {fault.detail}" if fault and fault.detail else last
        return SourceError(
            f"{self.name}: {fault.kind if fault else 'no frames'}, no good frame for "
            f"{now - self._good_at:.1f} s{detail}; check its cable, power and light and what else may be "
            "using it; no_frame_timeout sets how long to wait (0: forever)"
        )

    def _report(self, kind: str, since: float, now: float, detail: str = "") -> None:
        hour = time.strftime("%H:%M:%S", time.localtime(self._clock.unix() - (now - since)))
        retry_at = now + self._watch.retry if kind == "gone" else now
        self._fault = _Fault(kind, since, hour, retry_at, detail)
        then = "" if not self._watch.reconnect else "; waiting" if kind == "no frames" else "; reconnecting"
        words = f"is {kind}" if kind == "gone" else kind
        reason = f": {detail}" if detail else ""
        log.warning("%s: %s since %s (%.1f s)%s%s", self.name, words, hour, now - since, reason, then)

    def _recover(self, fault: _Fault, now: float) -> None:
        self._fault = None
        tries = f", at attempt {fault.attempts}" if fault.attempts else ""
        log.warning("%s: is back after %.1f s%s (%s)", self.name, now - fault.since, tries, fault.kind)

    def _picture_problem(self, image: ColorImage, now: float) -> tuple[str, float, bool] | None:
        """The fault of a picture, its start (s), and whether it has lasted long enough to be reported.

        Black pictures at the start are a fault immediately, because they must not become the reference.
        """
        watch = self._watch
        if watch.black_after is not None:
            if float(image[::SAMPLING_STEP_PX, ::SAMPLING_STEP_PX].mean()) > MAX_BLACK_MEAN_GREY:
                self._lit_at, self._lit = now, True
            lasts = now - self._lit_at >= watch.black_after
            if self._lit_at != now and (lasts or not self._lit):
                return "black pictures", self._lit_at, lasts
        if watch.frozen_after is not None:
            if self._previous is None or image.data != self._previous.data:
                self._previous, self._changed_at = image, now
            elif now - self._changed_at >= watch.frozen_after:
                return "a frozen picture", self._changed_at, True
        return None

    # -- the reading thread -------------------------------------------------------------------------------

    def _work(self, source: FrameReader | None) -> None:
        """Read the source, and reopen it after faults, until the end."""
        while source is not None or self._wait_to_retry():
            try:
                with closing(source or self._reopen()) as opened:
                    while self._is_running():
                        item = opened.read()
                        if item is None:
                            self._fail(None)
                            break
                        if self._take(*item):
                            break
            except Exception as error:
                self._fail(error)
            source = None

    def _is_running(self) -> bool:
        return not self._ended and self._failure is None and not self._stopped.is_set()

    def _wait_to_retry(self) -> bool:
        """Wait for the next attempt to open the source; False at the end."""
        fault = self._fault
        if fault is None or not self._is_running():
            return False
        self._clock.sleep(fault.retry_at - self._clock.now(), self._stopped)
        fault.attempts += 1
        fault.retry_at = self._clock.now() + self._watch.retry
        return self._is_running()

    def _reopen(self) -> FrameReader:
        source = self._opener()
        with self._changed:
            if self._fault is not None:
                self._fault.detail = "it was opened, but gave no good frame"
        return source

    def _take(self, image: ColorImage, t: float) -> bool:
        """Handle a new frame; returns whether to reopen the source."""
        now = self._clock.now()
        with self._changed:
            self._arrived_at = now
            size, first = (image.shape[1], image.shape[0]), self.size
            if first is None or self._seq < 0:
                # The driver may have stated another size.
                self.size = size
            elif size != first:
                raise SourceError(
                    f"it came back with {size[0]} x {size[1]} pixels instead of {first[0]} x {first[1]}"
                )
            self._seq += 1
            problem = self._picture_problem(image, now)
            if problem is not None:
                kind, since, reportable = problem
                if self._fault is None and reportable:
                    self._report(kind, since, now)
                return self._fault is not None and self._watch.reconnect and now >= self._fault.retry_at
            if self._fault is not None:
                self._recover(self._fault, now)
            self._good_at = now
            self._t = max(t, float(np.nextafter(self._t, np.inf)))
            self.missed += self._newest is not None
            self._newest = Arrival(image, self._t, self._seq, captured=now)
            self._changed.notify_all()
            return False

    def _fail(self, error: Exception | None) -> None:
        """Handle an error on reading, or (None) the end of the source."""
        detail = "it ended" if error is None else str(error).removeprefix(f"{self.name}: ")
        if error is not None and not isinstance(error, SourceError):
            detail = f"{type(error).__name__}: {detail}"
        with self._changed:
            if not self._watch.reconnect:
                self._ended = True
                if error is None:
                    log.warning("%s: the stream ended after %d frames", self.name, self._seq + 1)
                else:
                    self._failure = SourceError(f"{self.name}: {detail}")
            elif self._fault is None:
                self._report("gone", self._arrived_at, self._clock.now(), detail)
            else:
                self._fault.detail = detail
            self._changed.notify_all()
