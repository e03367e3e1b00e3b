"""A source that repeats a few pictures; copied to the folder of the pipeline file."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
from pydantic import Field

from tactflow import Frame, Source, StageParams


class Endless(Source):
    """Pictures at a fixed rate, like a camera, or as fast as possible, like a recording.

    The time of a live frame is its due time on the monotonic clock, which all processes share, so that
    subscribers can measure the age of a result.
    """

    class Params(StageParams):
        """Pictures and rate."""

        pictures: str = Field(description=".npy file")
        rate: float = Field(0.0, description="frames per second; 0: as fast as possible")
        frames: int = Field(1_000_000_000, description="number of frames")

    def __init__(self, params: Params, sensor: str) -> None:
        super().__init__(params)
        self.params = params
        self.live = params.rate > 0
        self.total = None if self.live else params.frames
        self._sensor = sensor
        self._stopped = threading.Event()

    def frames(self) -> Iterator[Frame]:
        """Yield each frame when it is due."""
        pictures = np.load(self.params.pictures)
        pictures.flags.writeable = False
        began = time.perf_counter()
        for seq in range(self.params.frames):
            t = began + seq / self.params.rate if self.live else seq / 60
            if self._stopped.wait(max(0.0, t - time.perf_counter()) if self.live else 0.0):
                return
            captured = t if self.live else time.perf_counter()
            yield Frame(self._sensor, seq, t, pictures[seq % len(pictures)], captured, reference=seq == 0)

    def stop(self) -> None:
        """End the frames."""
        self._stopped.set()
