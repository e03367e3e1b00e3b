"""A live source that follows a script."""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources import Arrival, Watched
from tests.clock import PATIENCE, ManualClock

PERIOD = 0.01
"""Time between the scripted device's frames on its clock, s."""
REAL_PERIOD = 0.001
"""What reading a frame really takes, s, so that other threads get on meanwhile."""


class Flaky:
    """A device whose behaviour a test changes while it is read: `does` is what it does now.

    good: noisy frames. black: black frames, not all the same. frozen: one frame again and again. gone:
    reading and opening fail. ends: reading says that it is the end; opening works. hangs: reading does not
    return until `free` is set; opening works. other_size: gone, and what then can be opened gives
    pictures of another size, whatever size it states.

    Time passes on `clock` while the newest connection is read, and nowhere else.
    """

    def __init__(self, does: str = "good") -> None:
        self.does = does
        self.clock = ManualClock(pause=REAL_PERIOD)
        self.free = threading.Event()
        self.opened = 0
        self.closed = 0
        self.stamp = 1000.0
        self.newest: Connection | None = None
        self.rng = np.random.default_rng(1)
        self.last = self.noisy()
        self._heals_in = 0

    def fail(self, does: str, openings: int) -> None:
        """Begin to do this, and be good again with that many attempts to open it."""
        self._heals_in = openings
        self.does = does

    def noisy(self, level: int = 90) -> NDArray[np.uint8]:
        light = np.arange(64, dtype=np.uint8)[:, None] if level else np.uint8(0)
        return self.rng.integers(level, level + 20, (48, 64, 3), np.uint8) + light

    def open(self, *_: object, **__: object) -> Connection:
        if self._heals_in > 0:
            self._heals_in -= 1
            if self._heals_in == 0:
                self.does = "good"
        if self.does == "gone":
            raise SourceError("flaky: nothing is plugged in")
        self.opened += 1
        self.newest = Connection(self)
        return self.newest


class Connection:
    """One opening of the device."""

    live = True
    fps: float | None = None
    total: int | None = None

    def __init__(self, device: Flaky) -> None:
        self.device = device
        self.size: tuple[int, int] | None = (64, 48)
        self._is_small = device.does == "other_size"
        self.description = "flaky, 64 x 48"

    def read(self) -> tuple[NDArray[np.uint8], float] | None:
        device = self.device
        time.sleep(REAL_PERIOD)
        device.clock.advance(PERIOD)
        does = device.does
        if does == "hangs":
            while not device.free.wait(REAL_PERIOD):
                if device.newest is self:
                    device.clock.advance(PERIOD)
            return None
        if does == "gone" or (does == "other_size" and not self._is_small):
            raise SourceError("flaky: delivers no more frames")
        if does == "ends":
            return None
        if does == "good":
            device.last = device.noisy()
        device.stamp += PERIOD
        image = device.noisy(level=0) // 10 if does == "black" else device.last.copy()
        image = image[:24, :32] if self._is_small else image
        return image, device.stamp

    def close(self) -> None:
        self.device.closed += 1


class Reading:
    """Reads a source in another thread, until its end or `stop`."""

    def __init__(self, source: Watched) -> None:
        self.source = source
        self.arrivals: list[Arrival] = []
        self.error = ""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            while (arrival := self.source.read_arrival()) is not None:
                self.arrivals.append(arrival)
        except SourceError as error:
            self.error = str(error)

    def join(self) -> None:
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()

    def stop(self) -> None:
        self.source.stop()
        self.join()
