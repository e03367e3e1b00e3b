"""A logarithmic axis of a plot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

_ROOM: Final = 1.12
"""Length of an axis over what its values span. Chosen by hand."""
_EDGE: Final = 0.06
"""Decades that are left free at both ends besides. Chosen by hand."""
_STEPS: Final = {1.0: (1, 1.5, 2, 3, 5, 7), 2.2: (1, 2, 5), math.inf: (1,)}
"""Decades that an axis spans at most -> values of a decade that are written. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class LogAxis:
    """A logarithmic axis from 10^low to 10^high between two positions, px.

    >>> axis = LogAxis(0.0, 2.0, 100.0, 300.0)
    >>> axis.at(10.0), axis.at(0.0), axis.ticks()
    (200.0, 100.0, [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0])
    """

    low: float
    high: float
    start: float
    end: float

    @classmethod
    def around(cls, values: Sequence[float], start: float, end: float, least: float = 0.0) -> Self:
        """The axis on which all of some values > 0 lie; it spans `least` decades at least."""
        low, high = math.log10(min(values)), math.log10(max(values))
        middle, half = (low + high) / 2, max((high - low) / 2 * _ROOM + _EDGE, least / 2)
        return cls(middle - half, middle + half, start, end)

    def at(self, value: float) -> float:
        """Where a value >= 0 lies, px; what is beyond an end lies at the end."""
        share = (math.log10(value) - self.low) / (self.high - self.low) if value > 0 else 0.0
        return self.start + min(max(share, 0.0), 1.0) * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Round values to write."""
        steps = next(steps for most, steps in _STEPS.items() if self.high - self.low <= most)
        decades = range(math.floor(self.low), math.ceil(self.high) + 1)
        values = [step * 10.0**decade for decade in decades for step in steps]
        return [v for v in values if self.low - 1e-9 <= math.log10(v) <= self.high + 1e-9]
