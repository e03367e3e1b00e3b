"""Plain version of the kernel that tells which points lie inside an outline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.inside import ALONG, RIDGE, SIDE, TIE, outline_depths
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# For each point to the sides of a gap: whether it belongs to the first end or to the second, to which side
# that is, and how far out it lies.
_WHICH: Final = np.repeat([0, 1], len(ALONG))
_SIGN: Final = np.repeat([-1.0, 1.0], len(ALONG))
_OUTWARD: Final = _SIGN * np.tile(ALONG, 2)
_RIDGE: Final = np.diag(RIDGE)
_NOBODY: Final = np.zeros(0, np.intp)


def plain_outline_depths(
    points: FloatArray,
    mask: NDArray[np.uint8],
    outlines: NDArray[np.int32],
    lines: NDArray[np.int64],
    box: FloatArray,
    hidden: float,
    reach: float,
    depth: FloatArray,
) -> None:
    """All gaps of all points at once, each fitted by numpy's solver."""
    near = np.flatnonzero(((points > box[:2]) & (points < box[2:])).all(axis=1))
    if len(near):
        parts = np.split(outlines, np.cumsum(lines[1])[:-1])
        depth[near] = _depths(points[near], mask, parts, lines[0].tolist(), hidden, reach)


def _depths(
    markers: FloatArray,
    mask: NDArray[np.uint8],
    outlines: Sequence[NDArray[np.int32]],
    steps: Sequence[int],
    hidden: float,
    reach: float,
) -> FloatArray:
    """(n,) px: what `outline_depths` computes, for markers (n, 2) near the region."""
    column, row = np.rint(markers).astype(np.intp).T
    on = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    on[on] = mask[row[on], column[on]] != 0
    squared = np.full(len(markers), np.inf)
    bridged = np.full(len(markers), np.inf)
    for outline, step in zip(outlines, steps, strict=True):
        corners = outline.astype(np.float64)
        away = markers[:, :1] - corners[:, 0], markers[:, 1:] - corners[:, 1]
        lengths = away[0] * away[0] + away[1] * away[1]
        nearest = lengths.min(axis=1)
        np.minimum(squared, nearest, out=squared)
        if nearest.min() > hidden * hidden:
            continue
        which, before, after = _gaps(lengths > hidden * hidden)
        if len(which):
            found = _beyond(markers[which], corners, before, after, hidden / step, max(hidden, 1.0))
            for marker, value in zip(which.tolist(), found.tolist(), strict=True):
                if abs(value + TIE) < abs(bridged[marker] + TIE):
                    bridged[marker] = value
    distance = np.where(squared < reach * reach, np.sqrt(squared), np.inf)
    plain = np.where(on, distance + 0.5, 0.5 - distance)
    return np.where(np.isfinite(bridged), bridged + 0.5, plain)


def _gaps(seen: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
    """Parts of a closed outline that a marker hides.

    seen : (m, n) bool, whether point n of the outline is out of marker m's reach.
    Returns for each gap its marker, the last point before and the first point after it.
    """
    count = seen.shape[1]
    first = seen.argmax(axis=1)
    markers = np.flatnonzero(seen[np.arange(len(seen)), first] & ~seen.all(axis=1))
    if len(markers) == 0:
        return (_NOBODY,) * 3
    # Each row begins with a point that is seen, so that no gap goes round the end.
    rows = np.take_along_axis(seen[markers], (np.arange(count + 1) + first[markers, None]) % count, axis=1)
    row, place = np.nonzero(rows[:, 1:] != rows[:, :-1])
    place += first[markers[row]]
    return markers[row[::2]], place[::2] % count, (place[1::2] + 1) % count


def _beyond(
    markers: FloatArray,
    outline: FloatArray,
    before: IntArray,
    after: IntArray,
    half_width: float,
    unit: float,
) -> FloatArray:
    """Signed distance (g,), px, of markers (g, 2) from the bridges over their gaps, positive inside.
    Infinite where all of the outline but for one point is hidden, which has no direction.

    half_width : of a gap, points of the outline. unit : px, a length of the size of a gap.

    With the marker as origin, the curve is v = a + b u + c (u^2 + v^2), at a distance of
    2 a / (g + sqrt(g^2 - 4 a c)), where g^2 = 1 + b^2; for c = 0 that is the distance from a line.
    """
    count = len(outline)
    side = min(SIDE * half_width, count / 2 - 1)
    borders = np.stack([before, after], axis=1)
    ends = (borders.take(_WHICH, axis=1) + np.rint(_OUTWARD * side).astype(np.intp)) % count
    known = (outline.take(ends, axis=0) - markers[:, None]) / unit
    corners = outline.take(borders, axis=0)
    chord = corners[:, 1] - corners[:, 0]
    length = np.sqrt((chord * chord).sum(axis=1))
    along, down = (chord / np.maximum(length, 1)[:, None]).T[:, :, None]
    # Along the chord, and into the region, which lies to the left of its outlines, as seen with y down.
    u = known[..., 0] * along + known[..., 1] * down
    v = known[..., 0] * down - known[..., 1] * along
    rows = np.empty((len(markers), 3, len(_WHICH)))
    rows[:, 0], rows[:, 1], rows[:, 2] = 1, u, u * u + v * v
    fit = np.linalg.solve(rows @ rows.transpose(0, 2, 1) + _RIDGE, rows @ v[..., None])
    a, b, c = fit[..., 0].T
    slope = 1 + b * b
    distance = -2 * a / (np.sqrt(slope) + np.sqrt(np.maximum(slope - 4 * a * c, 0)))
    return np.where(length > 0, distance * unit, np.inf)


# The ridge and the tie decide about an outline of two points around a marker, 1e-6 px; all else agrees to the
# 16 digits of doubles times a condition of at most 1e8.
GAINS = [Gain(outline_depths, plain_outline_depths, tolerance=1e-5)]
