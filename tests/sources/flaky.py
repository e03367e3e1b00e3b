"""A live source that follows a script."""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError

PERIOD = 0.01
"""Time between the scripted device's frames, s."""


class Flaky:
    """A device whose behaviour a test changes while it is read: `does` is what it does now.

    good: noisy frames. black: black frames, not all the same. frozen: one frame again and again. gone:
    reading and opening fail. ends: reading says that it is the end; opening works. hangs: reading does not
    return until `free` is set; opening works. other_size: gone, and what then can be opened has another size.
    """

    def __init__(self, does: str = "good") -> None:
        self.does = does
        self.free = threading.Event()
        self.opened = 0
        self.closed = 0
        self.rng = np.random.default_rng(1)
        self.clock = 1000.0
        self.step = 0.01
        self.last = self.noisy()

    def noisy(self, level: int = 90) -> NDArray[np.uint8]:
        return self.rng.integers(level, level + 20, (48, 64, 3), np.uint8)

    def open(self, *_: object, **__: object) -> Connection:
        if self.does == "gone":
            raise SourceError("flaky: nothing is plugged in")
        self.opened += 1
        return Connection(self)


class Connection:
    """One opening of the device."""

    live = True
    fps: float | None = None
    total: int | None = None

    def __init__(self, device: Flaky) -> None:
        self.device = device
        self.size: tuple[int, int] | None = (32, 24) if device.does == "other_size" else (64, 48)
        self.first = device.opened == 1
        self.description = "flaky, 64 x 48"

    def read(self) -> tuple[NDArray[np.uint8], float] | None:
        device = self.device
        time.sleep(PERIOD)
        does = device.does
        if does == "hangs":
            device.free.wait()
            return None
        if does in ("gone", "other_size"):
            raise SourceError("flaky: delivers no more frames")
        if does == "ends":
            return None
        if does == "good":
            device.last = device.noisy()
        device.clock += device.step
        image = device.noisy(level=0) // 10 if does == "black" else device.last.copy()
        return image, device.clock

    def close(self) -> None:
        self.device.closed += 1
