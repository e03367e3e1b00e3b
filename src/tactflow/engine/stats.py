"""Durations and counters of a run, in constant memory."""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count

import numpy as np

_BINS_PER_E = 50
"""Bins per factor e: a quantile is exact to +-1 %."""
_SMALLEST = 1e-7
_BINS = 26 * _BINS_PER_E
"""The shortest duration that is told apart, s, and the number of bins from there on: 26 factors of e, 5 h."""
_WAITING = 256
"""Durations that wait to be sorted in. Chosen by hand: a hundred frames of the shipped pipeline wait less."""
_number = count()


class Durations:
    """A histogram of durations with bins of equal ratio; quantiles are good to 1 %.

    Covers 0.1 us to about 5 h; shorter and longer ones count in the outermost bins. Any thread may
    add and ask.
    """

    def __init__(self) -> None:
        self._bins = np.zeros(_BINS, np.int64)
        self._total = 0.0
        # Sorted into their bins together: 0.4 us for each instead of 1.0 one by one (Python 3.11), for every
        # stage of every frame. Not all histograms of a run do it in the same frame.
        self._new: deque[float] = deque()
        self._limit = _WAITING + next(_number) % 32 * 8
        self._lock = threading.Lock()

    def add(self, seconds: float) -> None:
        """Count one duration, s."""
        self._new.append(seconds)
        if len(self._new) >= self._limit:
            self._sort_in()

    def _sort_in(self) -> None:
        with self._lock:
            new = [self._new.popleft() for _ in range(len(self._new))]
            index = np.log(np.maximum(new, _SMALLEST) / _SMALLEST) * _BINS_PER_E
            self._bins += np.bincount(np.minimum(index.astype(np.int64), _BINS - 1), minlength=_BINS)
            self._total = sum(new, self._total)

    @property
    def count(self) -> int:
        """How many were counted."""
        self._sort_in()
        return int(self._bins.sum())

    @property
    def total(self) -> float:
        """Their sum, s."""
        self._sort_in()
        return self._total

    def quantile(self, q: float) -> float | None:
        """The duration that a share `q` in [0, 1] does not exceed, s; None when nothing was counted."""
        self._sort_in()
        seen = np.cumsum(self._bins)
        if not seen[-1]:
            return None
        index = int(np.searchsorted(seen, max(1, math.ceil(q * seen[-1]))))
        return _SMALLEST * math.exp((index + 0.5) / _BINS_PER_E)

    def milliseconds(self, q: float) -> float | None:
        """`quantile` in ms, rounded to 4 digits after the point."""
        value = self.quantile(q)
        return None if value is None else round(value * 1000, 4)


@dataclass(slots=True)
class NodeStats:
    """What a stage or sink did. Written by the one thread that runs it.

    skips : reason -> frames in which it did not run. errors : frames in which it failed. durations : of its
    runs.
    """

    skips: Counter[str] = field(default_factory=Counter)
    errors: int = 0
    durations: Durations = field(default_factory=Durations)

    @property
    def runs(self) -> int:
        """How often it ran to the end."""
        return self.durations.count


@dataclass(slots=True)
class SignalStats:
    """How often a boolean port was True, and how often it rose. last : its value in the last tick."""

    true: int = 0
    rises: int = 0
    last: bool = False

    def add(self, value: bool) -> None:
        """Count one tick."""
        self.true += value
        self.rises += value and not self.last
        self.last = value

    def __iter__(self) -> Iterator[tuple[str, int]]:
        yield "true", self.true
        yield "rises", self.rises
