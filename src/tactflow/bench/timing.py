"""Time of alternatives, measured so that they can be compared.

Two habits make ratios trustworthy on a machine that other programs share: alternatives take turns
(A B A B ...), so that a slow moment hits all of them alike; and the process's own CPU time is kept beside the
wall time, which counts what others did. A turn is `BLOCK` frames in a row: within it, an alternative streams
as it does in use, with its code and buffers in the cache.

The unit "copy" is the median time in which the same machine, in the same run, copies one raw frame of
800 x 600 x 3 bytes. It carries results from one machine to another far better than milliseconds do.
"""

from __future__ import annotations

import gc
import mmap
import statistics
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK = 20
"""Frames that an alternative gets in a turn. After the turns of others its first frame takes 1.5 to 2 times
as long, its second 1.1 to 1.3 times, the later ones as long as in a run of its own: of 20 that leaves the
median where it belongs (of 5 it did not), and a turn is still short beside a recording."""

RAW_SHAPE = (600, 800, 3)
"""Shape of the raw frame whose copy is the unit of time."""


@dataclass(slots=True)
class Samples:
    """Times of one alternative, s."""

    cpu: list[float] = field(default_factory=list[float])
    wall: list[float] = field(default_factory=list[float])

    def add(self, cpu: float, wall: float) -> None:
        """Add one measured call."""
        self.cpu.append(cpu)
        self.wall.append(wall)

    def summary(self) -> dict[str, float]:
        """`cpu_ms_p50`, `cpu_ms_p99`, `wall_ms_p50`, `wall_ms_p99` and `count`; empty without samples."""
        if not self.cpu:
            return {}
        cpu = 1e3 * np.asarray(self.cpu)
        wall = 1e3 * np.asarray(self.wall)
        return {
            "cpu_ms_p50": float(np.median(cpu)),
            "cpu_ms_p99": float(np.percentile(cpu, 99)),
            "wall_ms_p50": float(np.median(wall)),
            "wall_ms_p99": float(np.percentile(wall, 99)),
            "count": float(cpu.size),
        }


def timed(call: Callable[[], Any], samples: Samples) -> Any:
    """Call once, add its time to `samples`, and return what it returned."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = call()
    samples.add(time.process_time() - cpu, time.perf_counter() - wall)
    return result


class quiet:  # noqa: N801  (a context manager that reads as an adverb)
    """One OpenCV thread and no garbage collection inside the `with` block; both are restored after it."""

    def __enter__(self) -> None:
        self._threads = cv2.getNumThreads()
        self._collecting = gc.isenabled()
        cv2.setNumThreads(1)
        gc.collect()
        gc.disable()

    def __exit__(self, *_: object) -> None:
        cv2.setNumThreads(self._threads)
        if self._collecting:
            gc.enable()


def interleaved(
    alternatives: Mapping[str, Callable[[Any], Any]],
    inputs: Iterable[tuple[Hashable, Any]],
    *,
    block: int = BLOCK,
    see: Callable[[str, Hashable, Any, Any], None] | None = None,
) -> dict[str, dict[Hashable, Samples]]:
    """Give every input to every alternative, in turns of a few inputs, and time each call.

    Parameters
    ----------
    alternatives : name -> callable of one input.
    inputs : (kind, input) pairs; times are kept apart by kind (for instance with and without contact).
    block : inputs in a turn; their results are kept until it ends.
    see : called after each turn, outside the timed part, with (name, kind, input, result).

    Returns
    -------
    name -> kind -> samples.
    """
    times: dict[str, dict[Hashable, Samples]] = {name: {} for name in alternatives}
    waiting = iter(inputs)
    with quiet():
        while turn := list(islice(waiting, block)):
            for name, call in alternatives.items():
                results: list[Any] = []
                for kind, value in turn:
                    samples = times[name].setdefault(kind, Samples())
                    results.append(timed(lambda call=call, value=value: call(value), samples))  # type: ignore[misc]
                if see is not None:
                    for (kind, value), result in zip(turn, results, strict=True):
                        see(name, kind, value, result)
    return times


class CopyUnit:
    """The machine's own yardstick, to be taken again and again during a run.

    `take` measures one copy of a raw frame and one pass that reads and writes every byte once (the least
    that any method which looks at the whole frame can cost); `copy_ms` and `touch_ms` are the medians.
    Source and destination come from a pool several times as large as any cache nearby, because a camera's
    frame is in memory too, and not in the cache, when it arrives; page size, alignment, and whether the pages
    belong to a file in the page cache make no difference. Take many in a row, as pipelines are given many
    frames in a row: the first copy after other work takes a fifth to a half longer than the next ones, and
    the median of single ones changes with whatever that work was.

    All of that memory has been written before. What it costs to write to memory for the first time, so that
    the operating system must provide it page by page, is `fault_us`: on some machines a copy into fresh
    memory takes several times as long as one into memory that is there.
    """

    _POOL = 120
    _FRESH_EVERY = 8

    def __init__(self) -> None:
        self._pool = [np.full(RAW_SHAPE, value, dtype=np.uint8) for value in range(self._POOL)]
        self._copies: list[float] = []
        self._touches: list[float] = []
        self._fresh: list[float] = []

    def take(self, repeats: int = 1) -> None:
        """Measure `repeats` times."""
        quarter = self._POOL // 4
        for _ in range(repeats):
            here = len(self._copies)
            a, b, c, d = (self._pool[(here + step * quarter) % self._POOL] for step in range(4))
            start = time.perf_counter()
            np.copyto(c, a)
            middle = time.perf_counter()
            cv2.bitwise_not(b, dst=d)
            end = time.perf_counter()
            self._copies.append(middle - start)
            self._touches.append(end - middle)
            if here % self._FRESH_EVERY == 0:
                self._take_fresh(a)

    def _take_fresh(self, source: NDArray[np.uint8]) -> None:
        with mmap.mmap(-1, source.nbytes) as memory:
            fresh = np.frombuffer(memory, np.uint8).reshape(source.shape)
            start = time.perf_counter()
            np.copyto(fresh, source)
            self._fresh.append(time.perf_counter() - start)
            del fresh

    @property
    def fault_us(self) -> float:
        """Median time to provide one page of fresh memory, us."""
        pages = self._pool[0].nbytes / mmap.PAGESIZE
        return max(0.0, 1e6 * (statistics.median(self._fresh) - statistics.median(self._copies)) / pages)

    @property
    def copy_ms(self) -> float:
        """Median time of one copy, ms."""
        return 1e3 * statistics.median(self._copies)

    @property
    def touch_ms(self) -> float:
        """Median time to read and write every byte of the raw frame once, ms."""
        return 1e3 * statistics.median(self._touches)
