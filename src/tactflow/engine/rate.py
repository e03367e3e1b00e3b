"""Limiting the rate of a stream, by the times of its frames."""

from __future__ import annotations

TIME_TOLERANCE_S = 5e-7
"""Tolerance for the rounding of times in a recording, which are multiples of 1 / fps, s."""


class RateLimit:
    """Selects frames of a stream, at most `rate` per second.

    Parameters
    ----------
    rate : Hz, > 0; None selects all.
    """

    __slots__ = ("_due", "_rate")

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._due = float("-inf")

    def due(self, t: float) -> bool:
        """Whether to take a frame captured at t, s. Call once per frame, in the order of their times."""
        rate = self._rate
        if rate is None:
            return True
        if t + TIME_TOLERANCE_S < self._due:
            return False
        start = self._due if t - self._due < 1.0 / rate else t
        self._due = start + 1.0 / rate
        return True
