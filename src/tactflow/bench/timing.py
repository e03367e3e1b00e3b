"""Comparable CPU times of alternatives.

Two habits make ratios trustworthy on a machine that other programs share: alternatives take turns
(A B A B ...), so that a slow moment affects all of them alike; and the CPU time of the thread is measured,
not wall time, which includes other programs. A turn is `BLOCK` frames in a row: within it, an alternative
streams as it does in use, with its code and buffers in the cache.

The unit "copy" is the median time in which the same machine, in the same run, copies one raw frame of
800 x 600 x 3 bytes. It depends far less on the machine than milliseconds do.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np

BLOCK = 20
"""Frames that an alternative gets in a turn. After the turns of others its first frame takes 1.5 to 2 times
as long, its second 1.1 to 1.3 times, the later ones as long as in a run of its own: with 20, the median is
that of such a run (with 5 it was not), and a turn is still short compared with a recording."""

Times = dict[str, list[float]]
"""Kind of frame ("contact", "idle", "reference") -> CPU time of each such frame, s."""


@contextmanager
def quiet() -> Iterator[None]:
    """One OpenCV thread and no garbage collection within the block; both are restored after it."""
    threads, collecting = cv2.getNumThreads(), gc.isenabled()
    cv2.setNumThreads(1)
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        if collecting:
            gc.enable()


class CopyUnit:
    """The unit "copy", measured repeatedly during a run.

    Source and destination come from a pool several times as large as any cache nearby, because a camera's
    frame is in memory too, and not in the cache, when it arrives. All of that memory has been written before.
    """

    _POOL = 120
    """Raw frames in the pool: 173 MB."""

    def __init__(self) -> None:
        self._pool = [np.full((600, 800, 3), value, dtype=np.uint8) for value in range(self._POOL)]
        self._copies: list[float] = []

    def take(self) -> None:
        """Measure `BLOCK` copies in a row: the first one after other work takes longer than the next ones."""
        for _ in range(BLOCK):
            number = len(self._copies)
            source, target = (self._pool[(number + step) % self._POOL] for step in (0, self._POOL // 2))
            began = time.perf_counter()
            np.copyto(target, source)
            self._copies.append(time.perf_counter() - began)

    @property
    def copy_ms(self) -> float:
        """Median time of one copy, ms."""
        return 1e3 * statistics.median(self._copies)
