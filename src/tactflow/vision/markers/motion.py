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

    origin : (N, 2) float64, marks in the reference, px. pitch : px.
    prior : (N,) float64, probability of being a mark by its appearance, 0 to 1.
    against : (N,) float64, log likelihood ratio of staying over moving so far, 0 or more.

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
        moves = weigh_motion(displacement, stderr, seen, *around, self.against)
        if moves and self.against.max() > LEAVING_EVIDENCE:
            self.left = self._leaving()
        return moves


@kernel(
    "boolean(float64[:, ::1], float32[::1], boolean[::1], int64[:, ::1], float64[:, ::1], float64,"
    "float64[::1])"
)
def weigh_motion(
    displacement: Floats,
    stderr: Floats32,
    seen: Flags,
    around: Indices,
    share: Floats,
    rest: float,
    against: Floats,
) -> bool:
    """Update `against`, (N,), with the evidence of a frame; returns whether a mark moves.

    displacement : (N, 2). stderr, seen : (N,). around, share : (N, K), the neighbours, nearest first, and
    their weights in a mean. rest : maximum displacement of a resting mark along an axis.
    """
    moves, moving = np.empty(len(displacement), np.bool_), False
    for n in range(len(displacement)):
        moves[n] = max(abs(displacement[n, 0]), abs(displacement[n, 1])) > rest
        moving = moving or moves[n]
    for n in range(len(displacement) if moving else 0):
        beside = False
        for k in range(min(NEIGHBOUR_COUNT, around.shape[1])):
            beside = beside or (moves[around[n, k]] and seen[around[n, k]])
        if moves[n] or not (seen[n] and beside):
            continue
        total = mean_x = mean_y = squares = 0.0
        for k in range(around.shape[1]):
            if seen[around[n, k]]:
                x, y = displacement[around[n, k]]
                total, squares = total + share[n, k], squares + share[n, k] * (x * x + y * y)
                mean_x, mean_y = mean_x + share[n, k] * x, mean_y + share[n, k] * y
        if total < MIN_KNOWN_SHARE:
            continue
        mean_x, mean_y = mean_x / total, mean_y / total
        length = mean_x * mean_x + mean_y * mean_y
        expected = (squares / total - length) / 2 + stderr[n] * stderr[n] + MIN_RELATIVE_SCATTER**2 * length
        along = mean_x * displacement[n, 0] + mean_y * displacement[n, 1]
        against[n] = max(against[n], (length / 2 - along) / expected)
    return moving
