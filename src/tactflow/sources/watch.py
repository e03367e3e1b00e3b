"""Live sources that come and go: noticed, reported, reconnected.

A thread reads all the time and keeps only the newest frame, so that waiting for a frame can be ended at once,
a driver's buffer never goes stale, and a read that hangs is noticed. What counts as a fault: `health`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, FrameReader, log
from tactflow.sources.health import HANG_INTERVALS, Health, Verdict, Watch
from tactflow.system.clock import SYSTEM, Clock

OPENING_SECONDS = 15.0
"""Opening that takes longer hangs, s; more than what drivers and streams themselves allow. Chosen by
hand."""
MAX_ABANDONED = 4
"""No new attempt while so many threads hang in a driver. Chosen by hand."""
POLL_SECONDS = 0.1
"""How often a waiting reader looks for faults, s. Chosen by hand."""


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


class Watched:
    """A live source that is watched, and opened anew when it fails.

    The first opening happens here and must succeed: a wrong address is an error at once, not after a wait.

    Parameters
    ----------
    opener : opens the source; called again for each reconnection, in another thread.
    watch : what counts as a fault.
    name : what the source is called in messages.
    clock : tells the time, and lets it pass between two attempts.

    Raises
    ------
    SourceError
        If the source cannot be opened.

    Examples
    --------
    Any reader can stand for a camera:

    >>> from tactflow.sources.simulated import Simulated
    >>> source = Watched(lambda: Simulated("sim:idle?frames=100"), Watch(), "example")
    >>> image, t = source.read()
    >>> image.shape, source.state
    ((600, 800, 3), 'running')
    >>> source.close()
    """

    live = True
    total: int | None = None

    def __init__(
        self, opener: Callable[[], FrameReader], watch: Watch, name: str, clock: Clock = SYSTEM
    ) -> None:
        self._opener = opener
        self._watch = watch
        self._name = name
        self._clock = clock
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
        self._health = Health(watch, name, source.fps, clock)
        self._busy_since: float | None = None
        self._opening = False
        self._abandoned: list[threading.Thread] = []
        self._generation = 0
        self.reader = self._start(source)

    # -- the side that takes frames -----------------------------------------------------------------------

    @property
    def state(self) -> str:
        """How the source is: `running`, `waiting since ...` or `reconnecting since ...`."""
        return self._health.state

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
                self._look(self._clock.now())
                if not self._end:
                    self._clock.wait(POLL_SECONDS, self._changed)
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
        """Notice what no frame can tell: silence, the end of all patience, a read that hangs."""
        watch, health = self._watch, self._health
        health.look(now)
        if (error := health.given_up(now)) is not None:
            self._end = error
            return
        limit = OPENING_SECONDS if self._opening else max(watch.hang_after, HANG_INTERVALS * health.interval)
        if watch.reconnect and self._busy_since is not None and now - self._busy_since >= limit:
            self._abandoned = [thread for thread in self._abandoned if thread.is_alive()]
            if len(self._abandoned) < MAX_ABANDONED:
                self._abandoned.append(self.reader)
                self._generation += 1
                health.note("opening hangs" if self._opening else "reading hangs")
                self.reader = self._start(None)

    # -- the thread that reads ----------------------------------------------------------------------------

    def _start(self, source: FrameReader | None) -> threading.Thread:
        self._busy_since, self._opening = self._clock.now(), False
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
            self._busy_since, self._opening = self._clock.now(), opening
            return True

    def _connect(self, generation: int) -> FrameReader | None:
        """One attempt, when its time has come."""
        with self._changed:
            if generation != self._generation:
                return None
            self._busy_since = None
            wait = self._health.retry_at - self._clock.now()
        if self._clock.sleep(wait, self._stopped) or not self._enter(generation, opening=True):
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
        with self._changed:
            if generation == self._generation:
                self._health.missed_attempt(why, self._clock.now())

    def _step(self, generation: int, source: FrameReader) -> bool:
        """Read one frame; True if the source is to be opened anew."""
        why = "it ended"
        ended: SourceError | bool = True
        try:
            item = source.read()
        except Exception as error:
            item, why = None, self._words(error)
            ended = error if isinstance(error, SourceError) else SourceError(f"{self._name}: {why}")
        now = self._clock.now()
        with self._changed:
            if generation != self._generation or self._stopped.is_set():
                return True
            if item is not None:
                again = self._take(*item, now)
                self._changed.notify_all()
                return again
            if self._watch.reconnect:
                self._health.ended(why, now)
            else:
                if ended is True:
                    log.warning("%s: the stream ended after %d frames", self._name, self._seq + 1)
                self._end = ended
            self._changed.notify_all()
            return True

    def _take(self, image: BgrImage, t: float, now: float) -> bool:
        """A frame has arrived; True if it is faulty and the source is to be opened anew."""
        self._seq += 1
        if self.size is None:
            self.size = (image.shape[1], image.shape[0])
        verdict = self._health.frame(image, now)
        if verdict is Verdict.GOOD:
            self._t = max(t, float(np.nextafter(self._t, np.inf)))
            self.missed += self._slot is not None
            self._slot = Arrival(image, self._t, self._seq, self._connection, now)
        return verdict is Verdict.REOPEN

    def _words(self, error: Exception) -> str:
        text = str(error).removeprefix(f"{self._name}: ")
        return text if isinstance(error, SourceError) else f"{type(error).__name__}: {text}"
