"""Comparable CPU times of alternatives.

Two habits make ratios trustworthy on a machine that other programs share: alternatives take turns (A B A B
...), so that a slow moment affects all of them alike; and the CPU time of the thread is measured, not wall
time, which includes other programs. A turn is `TURN_FRAMES` frames in a row: within it, an alternative
streams as it does in use, with its code and buffers in the cache.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

TURN_FRAMES = 20
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
