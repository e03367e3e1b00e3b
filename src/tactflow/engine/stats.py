"""Durations and counters of a run, in constant memory."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field
from itertools import accumulate
from math import ceil, exp, log
from typing import Any

_BINS_PER_E = 50
"""Bins per factor e: a quantile is exact to +-1 %."""
_SMALLEST = 1e-7
_BINS = 26 * _BINS_PER_E
"""Shortest duration that is resolved, s, and the number of bins from there on: 26 factors of e, 5 h."""

_OFFSET = -log(_SMALLEST) * _BINS_PER_E


class Durations:
    """A histogram of durations with bins of equal ratio; quantiles are good to 1 %.

    Covers 0.1 us to about 5 h; shorter and longer ones count in the outermost bins. Any thread may
    add and ask.

    total : their sum, s.
    """

    def __init__(self) -> None:
        self.total = 0.0
        self._bins = [0] * _BINS
        self._lock = threading.Lock()

    def add(self, seconds: float) -> None:
        """Count one duration, s."""
        index = int(log(seconds) * _BINS_PER_E + _OFFSET) if seconds > _SMALLEST else 0
        with self._lock:
            self._bins[index if index < _BINS else -1] += 1
            self.total += seconds

    @property
    def count(self) -> int:
        """How many were counted."""
        return sum(self._bins)

    def quantile(self, q: float) -> float | None:
        """The duration that a share `q` in [0, 1] does not exceed, s; None when nothing was counted."""
        with self._lock:
            counts = list(accumulate(self._bins))
        if not counts[-1]:
            return None
        index = bisect_left(counts, max(1, ceil(q * counts[-1])))
        return _SMALLEST * exp((index + 0.5) / _BINS_PER_E)

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

    def entry(self) -> dict[str, Any]:
        """Its entry in the statistics file."""
        return {
            "runs": self.durations.count,
            "skips": dict(self.skips),
            "errors": self.errors,
            "total_ms": round(self.durations.total * 1000, 4),
            "p50_ms": self.durations.milliseconds(0.5),
            "p99_ms": self.durations.milliseconds(0.99),
        }


@dataclass(slots=True)
class SignalStats:
    """How often a boolean port was True, or there was a contact, and how often that began.

    last : its value in the last tick.
    """

    true: int = 0
    rises: int = 0
    last: bool = False

    def add(self, value: bool) -> None:
        """Count one tick."""
        self.true += value
        self.rises += value and not self.last
        self.last = value

    def entry(self) -> dict[str, int]:
        """Its entry in the statistics file."""
        return {"true": self.true, "rises": self.rises}
