"""Whether marks move with the gel: dirt before the camera and reflections stay where they are."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Floats32
from tactflow.vision.markers.matching import LEAST_SUPPORT, surroundings

BEST_AGREEMENT: Final = 0.25
"""Difference of a mark's displacement from the mean of those around it, over this mean, that is always
expected. In seven recordings and eight scenes the evidence against a true mark is then 4.1 at most, 3 in all
but one of them (measured)."""

LEAST_SPREAD: Final = 0.01
"""Difference that is always expected, px: the error of a mark without noise."""

NEAREST: Final = 4
"""Marks around, of which one has to move: those next to it on a square grid."""

FARTHER: Final = 1.2
"""Ratio of the largest displacements of two frames that are weighed: frames in between add little, for the
evidence grows with the displacement."""


class MotionEvidence:
    """Compares two explanations of where a mark is seen: it moves with the marks around it, or not at all.

    In one frame a mark that moves with those around is as far from their mean displacement as they are
    themselves: normally distributed. One that stays is so far from zero. Frames repeat each other, so only
    the strongest evidence of all frames counts, and only those are weighed in which the gel has moved
    farther than before, since it last rested.

    origin : (N, 2) float64, marks in the reference, px. pitch : px. rest : distance from its origin within
    which a mark rests, px.

    against : (N,) float64, logarithm of how much more probable it is that a mark stays, 0 or more.

    References
    ----------
    Wald, "Sequential tests of statistical hypotheses", Annals of Mathematical Statistics 16 (1945), for the
    ratio of likelihoods.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    >>> evidence = MotionEvidence(10 * np.column_stack([x.ravel(), y.ravel()]), 10.0, 1.0)
    >>> moved = np.full((25, 2), 2.0)
    >>> moved[12] = 0
    >>> evidence.add(moved, np.full(25, 0.02, np.float32), np.ones(25, bool))
    True
    >>> evidence.against[[12, 13]].round(1)
    array([8., 0.])
    """

    def __init__(self, origin: Floats, pitch: float, rest: float) -> None:
        self._around, self._weight = surroundings(origin, pitch)
        self._rest, self._farthest = rest**2, rest**2
        self.against = np.zeros(len(origin))

    def add(self, displacement: Floats, stderr: Floats32, seen: Flags) -> bool:
        """Take one frame into account; returns whether a mark that is seen is not at rest.

        displacement : (N, 2) float64, px. stderr : (N,) float32, px. seen : (N,) bool.
        """
        squared = np.where(seen, np.einsum("ni,ni->n", displacement, displacement), 0.0)
        farthest = float(squared.max(initial=0))
        if farthest <= self._rest:
            self._farthest = self._rest
            return False
        if farthest > self._farthest:
            self._farthest = FARTHER**2 * farthest
            self._weigh(displacement, stderr, seen, squared > self._rest)
        return True

    def _weigh(self, displacement: Floats, stderr: Floats32, seen: Flags, moves: Flags) -> None:
        """Raise `against` to the evidence of a frame, where a mark rests beside one that `moves`, (N,)."""
        resting = np.flatnonzero(seen & ~moves & moves[self._around[:, :NEAREST]].any(axis=1))
        around = self._around[resting]
        share = self._weight[resting] * seen[around]
        told = share.sum(axis=1) > LEAST_SUPPORT
        resting, around, share = resting[told], around[told], share[told]
        share /= share.sum(axis=1, keepdims=True)
        moved = displacement[around]
        mean = np.einsum("nk,nki->ni", share, moved)
        length = (mean**2).sum(axis=1)
        spread = np.maximum(np.einsum("nk,nki,nki->n", share, moved, moved) - length, 0) / 2
        expected = spread + stderr[resting] ** 2 + BEST_AGREEMENT**2 * length + LEAST_SPREAD**2
        along = (mean * displacement[resting]).sum(axis=1)
        self.against[resting] = np.maximum(self.against[resting], (length / 2 - along) / expected)
