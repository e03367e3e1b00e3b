"""Whether marks move with the gel: dirt before the camera and reflections stay where they are."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.sparse import csr_array

from tactflow.vision.arrays import Flags, Floats
from tactflow.vision.markers.interpolation import surroundings

BEST_AGREEMENT: Final = 0.25
"""Difference of a mark's displacement from the mean of those around it, over this mean, that is always
expected. In seven recordings and eight scenes the evidence against a true mark is then at most 4.1, as a
logarithm, and that for it was as strong in another frame (measured)."""

LEAST_WEIGHT: Final = 0.6
"""Sum of the weights of the seen marks around, at least: a single neighbour has 0.66."""

LEAST_SPREAD: Final = 0.01
"""Difference that is always expected, px: the error of a mark without noise."""


class MotionEvidence:
    """Compares two explanations of where a mark is seen: it moves with the marks around it, or not at all.

    In one frame a mark that moves with those around is as far from their mean displacement as they are
    themselves: normally distributed. One that stays is so far from zero. Frames repeat each other, so only
    the strongest evidence of all frames counts, once for and once against.

    origin : (N, 2) float64, marks in the reference, px. pitch : px.

    References
    ----------
    Wald, "Sequential tests of statistical hypotheses", Annals of Mathematical Statistics 16 (1945), for the
    ratio of likelihoods.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    >>> evidence = MotionEvidence(10 * np.column_stack([x.ravel(), y.ravel()]), 10.0)
    >>> moved = np.full((25, 2), 2.0)
    >>> moved[12] = 0
    >>> evidence.add(moved, np.full(25, 0.02), np.ones(25, bool))
    >>> evidence.log_odds[[12, 13]].round(1)
    array([-8.,  5.])
    """

    def __init__(self, origin: Floats, pitch: float) -> None:
        count = len(origin)
        near, weight = surroundings(origin, pitch)
        first = np.arange(count + 1) * near.shape[1]
        self._weights = csr_array((weight.ravel(), near.ravel(), first), shape=(count, count))
        self._moves, self._stays = np.zeros((2, count))

    @property
    def log_odds(self) -> Floats:
        """(N,) float64, logarithm of how much more probable it is that a mark moves with the gel."""
        return np.asarray(self._moves - self._stays, np.float64)

    def add(self, displacement: Floats, stderr: Floats, seen: Flags) -> None:
        """Take one frame into account.

        displacement : (N, 2) float64, px. stderr : (N,) float64, px. seen : (N,) bool; of others both may be
        anything finite.
        """
        squares = (displacement**2).sum(axis=1)
        sums = self._weights @ (
            np.column_stack([displacement, squares, np.ones_like(squares)]) * seen[:, None]
        )
        total = np.maximum(sums[:, 3], LEAST_WEIGHT)
        mean = sums[:, :2] / total[:, None]
        length = (mean**2).sum(axis=1)
        spread = np.maximum(sums[:, 2] / total - length, 0) / 2
        expected = spread + stderr**2 + BEST_AGREEMENT**2 * length + LEAST_SPREAD**2
        ratio = ((mean * displacement).sum(axis=1) - length / 2) / expected
        ratio = np.where(seen & (sums[:, 3] >= LEAST_WEIGHT), ratio, 0.0)
        self._moves = np.maximum(self._moves, ratio)
        self._stays = np.maximum(self._stays, -ratio)

    def extended(self, origin: Floats, pitch: float) -> MotionEvidence:
        """What is known of the marks, with others behind them."""
        longer = MotionEvidence(origin, pitch)
        known = len(self._moves)
        longer._moves[:known], longer._stays[:known] = self._moves, self._stays
        return longer
