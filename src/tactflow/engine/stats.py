"""Durations and counters of a run, in constant memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

_BINS_PER_E = 50
"""Bins per factor e: a quantile is exact to +-1 %."""
_SMALLEST = 1e-7


class Durations:
    """A histogram of durations with bins of equal ratio; quantiles are good to 1 %.

    Covers 0.1 us to about 3 h; shorter and longer ones count in the outermost bins.
    """

    def __init__(self) -> None:
        self._bins = [0] * (26 * _BINS_PER_E)
        self.count = 0
        self.total = 0.0

    def add(self, seconds: float) -> None:
        """Count one duration, s."""
        self.count += 1
        self.total += seconds
        index = int(math.log(seconds / _SMALLEST) * _BINS_PER_E) if seconds > _SMALLEST else 0
        self._bins[min(index, len(self._bins) - 1)] += 1

    def quantile(self, q: float) -> float | None:
        """The duration that a share `q` in [0, 1] does not exceed, s; None when nothing was counted."""
        if not self.count:
            return None
        rank = max(1, math.ceil(q * self.count))
        seen = 0
        for index, number in enumerate(self._bins):
            seen += number
            if seen >= rank:
                return _SMALLEST * math.exp((index + 0.5) / _BINS_PER_E)
        return None

    def milliseconds(self, q: float) -> float | None:
        """`quantile` in ms, rounded to 4 digits after the point."""
        value = self.quantile(q)
        return None if value is None else round(value * 1000, 4)


@dataclass(slots=True)
class NodeStats:
    """What a stage or sink did. Written by the one thread that runs it."""

    runs: int = 0
    skips: Counter[str] = field(default_factory=Counter)
    errors: int = 0
    durations: Durations = field(default_factory=Durations)


@dataclass(slots=True)
class SignalStats:
    """How often a boolean port was True, and how often it rose."""

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
