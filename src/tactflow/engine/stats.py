"""Durations and counters of a run, in constant memory."""

from __future__ import annotations

import json
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import accumulate
from math import ceil, exp, log
from operator import add
from pathlib import Path
from typing import Any

from tactflow.engine.errors import ConfigError

STATISTICS_KEYS = {"frames", "stages", "sinks", "latency_ms"}
"""Keys by which a statistics file is recognised."""
_BINS_PER_E = 50
"""Bins per factor e: a quantile is exact to +-1 %."""
_MIN_DURATION_S = 1e-7
_BIN_COUNT = 26 * _BINS_PER_E
"""Shortest duration that is resolved, s, and the number of bins from there on: 26 factors of e, 5 h."""

_BIN_OFFSET = -log(_MIN_DURATION_S) * _BINS_PER_E


class Durations:
    """A histogram of durations with logarithmic bins; quantiles are accurate to 1 %.

    Covers 0.1 us to about 5 h; values outside count in the outermost bins. One thread adds, any may read.

    Attributes
    ----------
    total : sum of the durations, s.
    """

    def __init__(self) -> None:
        self.total = 0.0
        self._bins = [0] * _BIN_COUNT

    def add(self, seconds: float) -> None:
        """Count one duration, s."""
        index = int(log(seconds) * _BINS_PER_E + _BIN_OFFSET) if seconds > _MIN_DURATION_S else 0
        self._bins[index if index < _BIN_COUNT else -1] += 1
        self.total += seconds

    @classmethod
    def joined(cls, parts: Iterable[Durations]) -> Durations:
        """All durations of several histograms."""
        whole = cls()
        for part in parts:
            whole.total += part.total
            whole._bins = list(map(add, whole._bins, part._bins))
        return whole

    @property
    def count(self) -> int:
        """Number of durations."""
        return sum(self._bins)

    def quantile(self, q: float) -> float | None:
        """The quantile q in [0, 1], s; None without durations."""
        counts = list(accumulate(self._bins))
        if not counts[-1]:
            return None
        index = bisect_left(counts, max(1, ceil(q * counts[-1])))
        return _MIN_DURATION_S * exp((index + 0.5) / _BINS_PER_E)

    def milliseconds(self, q: float) -> float | None:
        """`quantile` in ms, rounded to 4 decimals."""
        value = self.quantile(q)
        return None if value is None else round(value * 1000, 4)


@dataclass(slots=True)
class NodeStats:
    """Statistics of a stage or sink, written by the thread of its segment.

    Attributes
    ----------
    skips : reason -> number of frames in which it did not run.
    errors : number of frames in which it failed.
    durations : of its runs.
    """

    skips: Counter[str] = field(default_factory=Counter)
    errors: int = 0
    durations: Durations = field(default_factory=Durations)

    def entry(self) -> dict[str, Any]:
        """The entry in the statistics file."""
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
    """Counts of a boolean port, or of the presence of an output that may be absent.

    Attributes
    ----------
    true : ticks in which it was true.
    rises : changes to true.
    last : value in the last tick.
    """

    true: int = 0
    rises: int = 0
    last: bool = False

    def add(self, value: bool) -> None:
        """Count one tick."""
        if value:
            self.true += 1
            if not self.last:
                self.rises += 1
        self.last = value

    def entry(self) -> dict[str, int]:
        """The entry in the statistics file."""
        return {"true": self.true, "rises": self.rises}


def read_statistics(path: Path) -> dict[str, Any]:
    """Read the statistics file of a run. Raises ConfigError if it cannot be read, or is not one."""
    try:
        statistics = json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"--stats {path}: cannot be read: {error.strerror}") from None
    except ValueError:
        statistics = None
    if not isinstance(statistics, dict) or not statistics.keys() >= STATISTICS_KEYS:
        raise ConfigError(f"--stats {path}: not a statistics file; tactflow run --stats writes one")
    return statistics
