"""The outline of a contact where marks hide it: bridged from what is seen to both sides.

Under a mark, and next to it, the gel's own light is not seen but filled in. A contact's region has a dent or
a bulge there, however it was found: where the region's own outline is continued below marks, it errs at them
by 0.9 px (scaled median deviation, 11 000 marks of simulated contacts), the bridge by 0.6 px. Whether a mark
at the rim is inside must therefore not be asked of the region's pixels below it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.contact import inside_kernels
from tactflow.vision.contact.inside_kernels import ALONG, RIDGE, SIDE, TIE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# For each point to the sides of a gap: whether it belongs to the first end or to the second, to which side
# that is, and how far out it lies.
_WHICH: Final = np.repeat([0, 1], len(ALONG))
_SIGN: Final = np.repeat([-1.0, 1.0], len(ALONG))
_OUTWARD: Final = _SIGN * np.tile(ALONG, 2)
_RIDGE: Final = np.diag(RIDGE)
# Of an outline with more points, every second is enough.
_MANY: Final = 400
_NOBODY: Final = np.zeros(0, np.intp)


def inside_outline(
    points: NDArray[Any], mask: NDArray[np.uint8], hidden: float, dilate: float = 0.0
) -> NDArray[np.bool_]:
    """Which marks lie inside a region, or at most `dilate` px outside of its outline.

    points : (N, 2) float, centres of the marks, px, x right, y down.
    mask : (H, W) uint8, non-zero in the region. A pixel is a square: the outline runs half a pixel outside of
        the centres of the outermost ones.
    hidden : px, >= 0. Outline that is nearer than this to a mark is not trusted for this mark: it is replaced
        by the circle, or line, that fits what is seen of it to both sides. Larger values are safer against
        dents and know less of corners.
    dilate : px, >= 0, to a fraction of a pixel.

    The circle is the least-squares fit of its equation, which is linear in three parameters (Kasa, "A circle
    fitting procedure and its error analysis", IEEE Trans. Instrum. Meas. 1976); one of them is the curvature,
    so that a line is a circle like others.

    Returns (N,) bool. Raises ValueError if mask is not (H, W) uint8, or if hidden or dilate is negative or
    not finite. Computed in float64.
    """
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    for name, value in (("hidden", hidden), ("dilate", dilate)):
        if not (value >= 0 and math.isfinite(value)):
            raise ValueError(f"required {name} >= 0 px, got {value}")
    return outline_depth(points, mask, hidden, max(dilate, hidden) + 1) >= -dilate


def outline_depth(points: NDArray[Any], mask: NDArray[np.uint8], hidden: float, reach: float) -> FloatArray:
    """How deep marks lie inside a region: their distance (N,) from its outline, px, negative outside.

    points, mask, hidden : as `inside_outline` takes them. reach : px, >= hidden; where the outline is further
        away, a mark is told inf inside, -inf outside.

    With numba and without, distances agree to 1e-5 px.
    """
    if len(points) == 0 or mask.size == 0:
        return np.full(len(points), -np.inf)
    lines = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    if len(lines) == 0:
        return np.full(len(points), -np.inf)
    steps = [2 if len(line) > _MANY else 1 for line in lines]
    outlines = [np.asarray(line[::step, 0], np.int32) for line, step in zip(lines, steps, strict=True)]
    if compiled.active():
        depth = np.empty(len(points))
        inside_kernels.outline_depths(
            np.ascontiguousarray(points, np.float64),
            np.ascontiguousarray(mask),
            np.concatenate(outlines) if len(outlines) > 1 else np.ascontiguousarray(outlines[0]),
            np.array([steps, list(map(len, outlines))]),
            hidden,
            reach,
            depth,
        )
        return depth
    depth = np.full(len(points), -np.inf)
    left, top, width, height = cv2.boundingRect(np.concatenate(outlines))
    low, high = (left - reach, top - reach), (left + width - 1 + reach, top + height - 1 + reach)
    near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    if len(near):
        depth[near] = _depths(np.asarray(points[near], np.float64), mask, outlines, steps, hidden, reach)
    return depth


def _depths(
    marks: FloatArray,
    mask: NDArray[np.uint8],
    outlines: Sequence[NDArray[np.int32]],
    steps: Sequence[int],
    hidden: float,
    reach: float,
) -> FloatArray:
    """(n,) px: what the kernel `outline_depths` computes, for marks (n, 2) near the region."""
    column, row = np.rint(marks).astype(np.intp).T
    on = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    on[on] = mask[row[on], column[on]] != 0
    squared = np.full(len(marks), np.inf)
    bridged = np.full(len(marks), np.inf)
    for outline, step in zip(outlines, steps, strict=True):
        corners = outline.astype(np.float64)
        away = marks[:, :1] - corners[:, 0], marks[:, 1:] - corners[:, 1]
        lengths = away[0] * away[0] + away[1] * away[1]
        nearest = lengths.min(axis=1)
        np.minimum(squared, nearest, out=squared)
        if nearest.min() > hidden * hidden:
            continue
        which, before, after = _gaps(lengths > hidden * hidden)
        if len(which):
            found = _beyond(marks[which], corners, before, after, hidden / step, max(hidden, 1.0))
            for mark, value in zip(which.tolist(), found.tolist(), strict=True):
                if abs(value + TIE) < abs(bridged[mark] + TIE):
                    bridged[mark] = value
    distance = np.where(squared < reach * reach, np.sqrt(squared), np.inf)
    plain = np.where(on, distance + 0.5, 0.5 - distance)
    return np.where(np.isfinite(bridged), bridged + 0.5, plain)


def _gaps(seen: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
    """Parts of a closed outline that a mark hides.

    seen : (m, n) bool, whether point n of the outline is out of mark m's reach.
    Returns for each gap its mark, the last point before and the first point after it.
    """
    count = seen.shape[1]
    first = seen.argmax(axis=1)
    marks = np.flatnonzero(seen[np.arange(len(seen)), first] & ~seen.all(axis=1))
    if len(marks) == 0:
        return (_NOBODY,) * 3
    # Each row begins with a point that is seen, so that no gap goes round the end.
    rows = np.take_along_axis(seen[marks], (np.arange(count + 1) + first[marks, None]) % count, axis=1)
    row, place = np.nonzero(rows[:, 1:] != rows[:, :-1])
    place += first[marks[row]]
    return marks[row[::2]], place[::2] % count, (place[1::2] + 1) % count


def _beyond(
    marks: FloatArray, outline: FloatArray, before: IntArray, after: IntArray, half_width: float, unit: float
) -> FloatArray:
    """Signed distance (g,), px, of marks (g, 2) from the bridges over their gaps, positive inside; inf where
    the whole outline but for one point is hidden, which has no direction.

    half_width : of a gap, points of the outline. unit : px, a length of the size of a gap.

    With the mark as origin, the curve is v = a + b u + c (u^2 + v^2), at a distance of
    2 a / (g + sqrt(g^2 - 4 a c)), where g^2 = 1 + b^2; for c = 0 that is the distance from a line.
    """
    count = len(outline)
    side = min(SIDE * half_width, count / 2 - 1)
    borders = np.stack([before, after], axis=1)
    ends = (borders.take(_WHICH, axis=1) + np.rint(_OUTWARD * side).astype(np.intp)) % count
    known = (outline.take(ends, axis=0) - marks[:, None]) / unit
    corners = outline.take(borders, axis=0)
    chord = corners[:, 1] - corners[:, 0]
    length = np.sqrt((chord * chord).sum(axis=1))
    along, down = (chord / np.maximum(length, 1)[:, None]).T[:, :, None]
    # Along the chord, and into the region, which lies to the left of its outlines, as seen with y down.
    u = known[..., 0] * along + known[..., 1] * down
    v = known[..., 0] * down - known[..., 1] * along
    rows = np.empty((len(marks), 3, len(_WHICH)))
    rows[:, 0], rows[:, 1], rows[:, 2] = 1, u, u * u + v * v
    fit = np.linalg.solve(rows @ rows.transpose(0, 2, 1) + _RIDGE, rows @ v[..., None])
    a, b, c = fit[..., 0].T
    slope = 1 + b * b
    distance = -2 * a / (np.sqrt(slope) + np.sqrt(np.maximum(slope - 4 * a * c, 0)))
    return np.where(length > 0, distance * unit, np.inf)
