"""A displacement that nearly all marks share: the jump of a whole grid between two frames."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Floats

BIN: Final = 0.1
"""Side of the bins of votes, pitches. Chosen by hand."""

AGREEMENT: Final = 2
"""Votes within so many bins of the peak agree with it: a fifth of a pitch for the scatter of the field."""

RIVAL: Final = 5
"""Another peak is looked for from so many bins on, half a pitch: nearer ones belong to the same peak."""

LEAST_VOTES: Final = 0.75
"""Fraction of the marks that have to agree. Chosen by hand."""

LEAST_LEAD: Final = 0.05
"""Lead over the next peak, as a fraction of the marks, and at least `LEAST_LEAD_VOTES`. Chosen by hand."""

LEAST_LEAD_VOTES: Final = 2.0
"""Lead over the next peak, votes. Chosen by hand."""


def common_displacement(position: Floats, spots: Floats, *, pitch: float, farthest: float) -> Floats | None:
    """The displacement that nearly all marks share, if there is clearly one.

    Every pair of a mark and a spot votes for its displacement. Only this tells a jump of the whole grid by
    nearly a pitch from a small one the other way, which all marks but those of one side would agree with.

    Parameters
    ----------
    position : (N, 2) float64, marks before, px.
    spots : (M, 2) float64, spots now, px.
    pitch : px. farthest : largest displacement, px.

    Returns
    -------
    displacement : (2,) float64, px; None where fewer than three quarters of the marks agree, or nearly as
        many agree with another.

    References
    ----------
    Ballard, "Generalizing the Hough transform to detect arbitrary shapes", Pattern Recognition 13 (1981).

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(0, 50, 10.0), np.arange(0, 50, 10.0))
    >>> position = np.column_stack([x.ravel(), y.ravel()])
    >>> common_displacement(position, position + [4.0, -3.0], pitch=10.0, farthest=13.0).round(6)
    array([ 4., -3.])
    """
    if len(spots) == 0:
        return None
    cell = BIN * pitch
    reach = int(farthest / cell)
    votes = _differences(position, spots, (reach + 1) * cell)
    bins = np.rint(votes / cell).astype(np.int64)
    near = (np.abs(bins) <= reach).all(axis=1)
    votes, bins = votes[near], bins[near] + reach
    side = 2 * reach + 1
    counts = np.bincount(bins[:, 1] * side + bins[:, 0], minlength=side * side).reshape(side, side)
    window = (2 * AGREEMENT + 1, 2 * AGREEMENT + 1)
    around = cv2.boxFilter(
        counts.astype(np.float32), -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    row, column = np.unravel_index(int(np.argmax(around)), around.shape)
    agree = (np.abs(bins - (column, row)) <= AGREEMENT).all(axis=1)
    most, count = int(agree.sum()), len(position)
    around[max(row - RIVAL, 0) : row + RIVAL + 1, max(column - RIVAL, 0) : column + RIVAL + 1] = 0
    lead = max(LEAST_LEAD_VOTES, LEAST_LEAD * count)
    if most < LEAST_VOTES * count or most < float(around.max()) + lead:
        return None
    return np.asarray(votes[agree].mean(axis=0), np.float64)


def _differences(points: Floats, others: Floats, reach: float) -> Floats:
    """All others - points (n, 2) whose y is within reach, so that not everything meets everything."""
    others = others[np.argsort(others[:, 1])]
    first = np.searchsorted(others[:, 1], points[:, 1] - reach)
    count = np.searchsorted(others[:, 1], points[:, 1] + reach) - first
    before = np.cumsum(count) - count
    other = np.arange(count.sum()) + np.repeat(first - before, count)
    return np.asarray(others[other] - np.repeat(points, count, axis=0), np.float64)
