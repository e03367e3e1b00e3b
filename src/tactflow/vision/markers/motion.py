"""Detect marks that do not move with the gel, such as dirt before the camera and reflections."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Floats32, Indices
from tactflow.vision.compiled import kernel
from tactflow.vision.markers.lattice import NEIGHBOUR_COUNT
from tactflow.vision.markers.matching import MIN_KNOWN_SHARE, surroundings

REST_DISPLACEMENT_PITCHES: Final = 0.1
"""Maximum displacement of a resting mark along either axis, pitches. Chosen by hand."""

MIN_RELATIVE_SCATTER: Final = 0.25
"""Expected scatter of a mark's displacement about the mean of its neighbours, relative to this mean, at best.
Chosen by hand."""

LEAVING_EVIDENCE: Final = 5.0
"""Log Bayes factor above which a mark is rejected because it stays while its neighbours move: very strong
evidence (Kass and Raftery, "Bayes factors", 1995)."""


class MotionEvidence:
    """Compares two hypotheses about each mark: it moves with its neighbours, or it does not move at all.

    The displacement of a mark that moves with its neighbours is normally distributed about their mean, with
    their scatter; that of one that stays is distributed about zero with the same scatter. Frames are
    correlated, so only the strongest evidence of all frames counts.

    Parameters
    ----------
    origin : (N, 2) float64, marks in the reference, px.
    pitch : px.
    prior : (N,) float64, probability of being a mark by its appearance, 0 to 1.
    against : (N,) float64, log likelihood ratio of staying over moving so far, 0 or more.

    Attributes
    ----------
    left : (n,) int64, marks that do not move with the gel.

    References
    ----------
    Wald, "Sequential tests of statistical hypotheses", Annals of Mathematical Statistics 16 (1945), for the
    ratio of likelihoods.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    >>> origin = 10 * np.column_stack([x.ravel(), y.ravel()])
    >>> evidence = MotionEvidence(origin, 10.0, np.full(25, 0.99), np.zeros(25))
    >>> moved = np.full((25, 2), 2.0)
    >>> moved[12] = 0
    >>> evidence.add(moved, np.full(25, 0.02, np.float32), np.ones(25, bool))
    True
    >>> evidence.against[[12, 13]].round(1), evidence.left
    (array([8., 0.]), array([12]))
    """

    def __init__(self, origin: Floats, pitch: float, prior: Floats, against: Floats) -> None:
        self._around, weight = surroundings(origin, pitch)
        self._share = weight / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        self._rest = REST_DISPLACEMENT_PITCHES * pitch
        self._log_odds = np.log(prior / (1 - prior))
        self.against = against
        self.left: Indices = self._leaving()

    @property
    def probability(self) -> Floats:
        """(N,) float64, of being a mark, 0 to 1."""
        return np.asarray(1 / (1 + np.exp(self.against - self._log_odds)), np.float64)

    def _leaving(self) -> Indices:
        return np.flatnonzero((self.against > LEAVING_EVIDENCE) & (self.against > self._log_odds))

    def add(self, displacement: Floats, stderr: Floats32, seen: Flags) -> bool:
        """Add one frame; returns whether the gel moves.

        displacement : (N, 2) float64, px. stderr : (N,) float32, px. seen : (N,) bool, visible marks.
        """
        around = self._around, self._share, self._rest
        moves = weigh_motion(
            displacement,
            stderr,
            seen,
            *around,
            self.against,
            NEIGHBOUR_COUNT,
            MIN_KNOWN_SHARE,
            MIN_RELATIVE_SCATTER,
        )
        if moves and self.against.max() > LEAVING_EVIDENCE:
            self.left = self._leaving()
        return moves


@kernel
def weigh_motion(
    displacement: Floats,
    stderr: Floats32,
    seen: Flags,
    around: Indices,
    share: Floats,
    rest: float,
    against: Floats,
    nearest: int,
    min_known: float,
    scatter: float,
) -> bool:
    """Update `against`, (N,), with the evidence of a frame; returns whether a mark moves.

    displacement : (N, 2). stderr, seen : (N,). around, share : (N, K), the neighbours, nearest first, and
    their weights in a mean. rest : maximum displacement of a resting mark along an axis. nearest : number of
    neighbours of which one must move. min_known : weight of the visible neighbours that is required.
    scatter : minimum scatter of a mark about the mean of its neighbours, relative to it.
    """
    moves = np.abs(displacement).max(axis=1, initial=0) > rest
    if not moves.any():
        return False
    near = around[:, :nearest]
    part = share * seen[around]
    total = part.sum(axis=1)
    tested = ~moves & seen & (moves & seen)[near].any(axis=1) & (total >= min_known)
    others, part, total = displacement[around[tested]], part[tested], total[tested]
    mean = (part[:, :, None] * others).sum(axis=1) / total[:, None]
    length = (mean * mean).sum(axis=1)
    spread = (part * (others * others).sum(axis=2)).sum(axis=1) / total - length
    expected = spread / 2 + stderr[tested].astype(np.float64) ** 2 + scatter**2 * length
    ratio = (length / 2 - (mean * displacement[tested]).sum(axis=1)) / expected
    against[tested] = np.maximum(against[tested], ratio)
    return True
