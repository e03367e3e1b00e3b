"""Whether marks move with the gel: dirt before the camera and reflections stay where they are."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Floats32, Indices
from tactflow.vision.compiled import kernel
from tactflow.vision.markers.interpolation import surroundings

BEST_AGREEMENT: Final = 0.25
"""Difference of a mark's displacement from the mean of those around it, over this mean, that is always
expected. In seven recordings and eight scenes the evidence against a true mark is then 4.1 at most, 3 in all
but one of them (measured)."""

LEAST_WEIGHT: Final = 0.6
"""Sum of the weights of the seen marks around, at least: a single neighbour has 0.66."""

LEAST_SPREAD: Final = 0.01
"""Difference that is always expected, px: the error of a mark without noise."""


NEAREST: Final = 4
"""Marks around, of which one has to move: those next to it on a square grid."""


class MotionEvidence:
    """Compares two explanations of where a mark is seen: it moves with the marks around it, or not at all.

    In one frame a mark that moves with those around is as far from their mean displacement as they are
    themselves: normally distributed. One that stays is so far from zero. Frames repeat each other, so only
    the strongest evidence of all frames counts.

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
        self._rest = rest
        self.against = np.zeros(len(origin))

    def add(self, displacement: Floats, stderr: Floats32, seen: Flags) -> bool:
        """Take one frame into account; returns whether a mark that is seen is not at rest.

        displacement : (N, 2) float64, px. stderr : (N,) float32, px. seen : (N,) bool.
        """
        return weigh_motion(
            displacement, stderr, seen, self._around, self._weight, self._rest**2, self.against
        )


@kernel(
    "boolean(float64[:, ::1], float32[::1], boolean[::1], int64[:, ::1], float64[:, ::1], float64,"
    "float64[::1])",
)
def weigh_motion(
    displacement: Floats,
    stderr: Floats32,
    seen: Flags,
    around: Indices,
    weight: Floats,
    rest: float,
    against: Floats,
) -> bool:
    """Raise `against`, (N,), to the evidence of a frame; returns whether a mark that is seen moves.

    displacement : (N, 2). stderr, seen : (N,). around, weight : (N, K), the marks around, nearest first, and
    their weights. rest : squared distance within which a mark rests.
    """
    count = len(displacement)
    moves, moving = np.empty(count, np.bool_), False
    for n in range(count):
        x, y = displacement[n, 0], displacement[n, 1]
        moves[n] = seen[n] and x * x + y * y > rest
        moving = moving or moves[n]
    if not moving:
        return False
    for n in range(count):
        near = False
        for k in range(min(NEAREST, around.shape[1])):
            near = near or moves[around[n, k]]
        if not near or moves[n] or not seen[n]:
            continue
        total = mean_x = mean_y = squares = 0.0
        for k in range(around.shape[1]):
            other, share = around[n, k], weight[n, k]
            if seen[other]:
                x, y = displacement[other, 0], displacement[other, 1]
                total, mean_x, mean_y = total + share, mean_x + share * x, mean_y + share * y
                squares += share * (x * x + y * y)
        if total < LEAST_WEIGHT:
            continue
        mean_x, mean_y = mean_x / total, mean_y / total
        length = mean_x * mean_x + mean_y * mean_y
        spread = max(squares / total - length, 0.0) / 2
        expected = spread + stderr[n] * stderr[n] + BEST_AGREEMENT**2 * length + LEAST_SPREAD**2
        along = mean_x * displacement[n, 0] + mean_y * displacement[n, 1]
        against[n] = max(against[n], (length / 2 - along) / expected)
    return True
