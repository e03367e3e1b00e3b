"""Thinning a stream to a rate, by the frames' own times."""

from __future__ import annotations

SLACK = 5e-7
"""Times of a recording are multiples of 1 / fps in floating point; so much, s, they may be off."""


class RateLimit:
    """Says which frames of a stream are taken, at most `rate` a second.

    rate : Hz, > 0; None takes every frame.
    """

    __slots__ = ("_due", "_rate")

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._due = float("-inf")

    def due(self, t: float) -> bool:
        """Whether a frame captured at t, s, is taken; asked once a frame, in the order of their times."""
        rate = self._rate
        if rate is None:
            return True
        if t + SLACK < self._due:
            return False
        start = self._due if t - self._due < 1.0 / rate else t
        self._due = start + 1.0 / rate
        return True
