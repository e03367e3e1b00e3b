"""The outline of a contact where marks hide it: bridged from what is seen to both sides.

Under a mark, and next to it, the gel's own light is not seen but filled in. A contact's region has a dent or
a bulge there, by one to three pixels (measured on simulated contacts: -1.5 px on average, to within 1.5 px
standard deviation; half a pixel where no mark is near). Whether a mark at the rim is inside must therefore
not be asked of the region's pixels below it.
"""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

# How much of the outline to each side of a gap takes part in its bridge, in half widths of the gap (less: the
# pixels' stairs tilt it; more: it cuts corners), and how many points of that.
_SIDE: Final = 1.5
_POINTS: Final = 12
# For each point to the sides of a gap: whether it belongs to the first end or to the second, to which side
# that is, and how far out it lies.
_WHICH: Final = np.repeat([0, 1], _POINTS)
_SIGN: Final = np.repeat([-1.0, 1.0], _POINTS)
_OUTWARD: Final = _SIGN * np.tile(np.linspace(0, 1, _POINTS), 2)
# Where along a gap its bridge is evaluated, in half widths from the middle.
_STEPS: Final = np.linspace(-1, 1, 9)
_BRIDGE: Final = np.stack([_STEPS**0, _STEPS, _STEPS**2], axis=1)
_TANGENT: Final = np.stack([0 * _STEPS, _STEPS**0, 2 * _STEPS], axis=1)
_MANY: Final = 400
_NOBODY: Final = np.zeros(0, np.intp)
# Weight of outline that other marks hide, against what is seen: it decides only where there is no other.
_ELSEWHERE: Final = 0.02
# A trace of ridge keeps a side of a few points solvable.
_RIDGE: Final = np.diag([1e-9, 1e-6, 1e-6])


def inside_outline(
    points: NDArray[Any], mask: NDArray[np.uint8], hidden: float, dilate: float = 0.0
) -> NDArray[np.bool_]:
    """Which marks lie inside a region, or at most `dilate` px outside of its outline.

    points : (N, 2) float, centres of the marks, px, x right, y down.
    mask : (H, W) uint8, non-zero in the region. A pixel is a square: the outline runs half a pixel outside of
        the centres of the outermost ones.
    hidden : px, >= 0. Outline that is nearer than this to a mark is not trusted for this mark: it is replaced
        by the parabola that fits what is seen of it to both sides. Larger values are safer against dents and
        know less of corners.
    dilate : px, >= 0, to a fraction of a pixel.

    The parabola is a least-squares fit of both coordinates as polynomials of second degree in the distance
    from the middle of the gap (Lancaster and Salkauskas, "Curve and surface fitting", 1986, ch. 2).

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

    points, mask, hidden : as `inside_outline` takes them. reach : px, >= hidden; marks further than this from
        the region's bounding box are told -inf.
    """
    depth = np.full(len(points), -np.inf)
    if len(points) == 0 or mask.size == 0:
        return depth
    left, top, width, height = cv2.boundingRect(mask)
    near = np.flatnonzero(
        (points[:, 0] > left - reach)
        & (points[:, 0] < left + width - 1 + reach)
        & (points[:, 1] > top - reach)
        & (points[:, 1] < top + height - 1 + reach)
    )
    if width == 0 or len(near) == 0:
        return depth
    region = mask[top : top + height, left : left + width]
    marks = np.asarray(points[near] - (left, top), np.float64)
    column, row = np.rint(marks).astype(np.intp).T
    on = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    on[on] = region[row[on], column[on]] != 0
    squared = np.full(len(near), np.inf)
    bridged = np.full(len(near), np.inf)
    for outline in cv2.findContours(region, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]:
        # Every second point is enough where there are many.
        spacing = 2 if len(outline) > _MANY else 1
        corners = outline[::spacing, 0].astype(np.float64)
        away = marks[:, :1] - corners[:, 0], marks[:, 1:] - corners[:, 1]
        lengths = away[0] * away[0] + away[1] * away[1]
        np.minimum(squared, lengths.min(axis=1), out=squared)
        seen = lengths > hidden * hidden
        everywhere = np.asarray(seen.all(axis=0), np.bool_)
        which, before, after = (_NOBODY,) * 3 if everywhere.all() else _gaps(seen)
        if len(which):
            found = _beyond(marks[which], corners, everywhere, before, after, hidden / spacing)
            for mark, value in zip(which.tolist(), found.tolist(), strict=True):
                if abs(value) < abs(bridged[mark]):
                    bridged[mark] = value
    distance = np.sqrt(squared)
    plain = np.where(on, distance + 0.5, 0.5 - distance)
    depth[near] = np.where(np.isfinite(bridged), bridged + 0.5, plain)
    return depth


def _gaps(seen: NDArray[np.bool_]) -> tuple[IntArray, IntArray, IntArray]:
    """Parts of a closed outline that a mark hides.

    seen : (m, n) bool, whether point n of the outline is out of mark m's reach.
    Returns for each gap its mark, the last point before and the first point after it.
    """
    count = seen.shape[1]
    first = seen.argmax(axis=1)
    marks = np.flatnonzero(seen[np.arange(len(seen)), first] & ~seen.all(axis=1))
    # Each row begins with a point that is seen, so that no gap goes round the end.
    rows = np.take_along_axis(seen[marks], (np.arange(count + 1) + first[marks, None]) % count, axis=1)
    row, place = np.nonzero(rows[:, 1:] != rows[:, :-1])
    place += first[marks[row]]
    return marks[row[::2]], place[::2] % count, (place[1::2] + 1) % count


def _beyond(
    marks: FloatArray,
    outline: FloatArray,
    seen: NDArray[np.bool_],
    before: IntArray,
    after: IntArray,
    half_width: float,
) -> FloatArray:
    """Signed distance (g,), px, of marks (g, 2) from the bridges over their gaps, positive inside.

    half_width : of a gap, points of the outline.
    """
    count = len(outline)
    side = min(_SIDE * half_width, count / 2 - 1)
    borders = np.stack([before, after], axis=1)
    ends = (borders.take(_WHICH, axis=1) + np.rint(_OUTWARD * side).astype(np.intp)) % count
    known = outline.take(ends, axis=0)
    corners = outline.take(borders, axis=0)
    chord = corners[:, 1] - corners[:, 0]
    half = np.maximum(0.5 * np.sqrt((chord * chord).sum(axis=1)), 0.5)
    away = known - corners.take(_WHICH, axis=1)
    place = _SIGN * (1 + np.sqrt((away * away).sum(axis=2)) / half[:, None])
    powers = np.empty((len(marks), 3, len(_WHICH)))
    powers[:, 0], powers[:, 1] = 1, place
    np.multiply(place, place, out=powers[:, 2])
    weighted = powers * np.maximum(seen.take(ends), _ELSEWHERE)[:, None]
    fit = np.linalg.solve(weighted @ powers.transpose(0, 2, 1) + _RIDGE, weighted @ known)
    offset = marks[:, None] - _BRIDGE @ fit
    tangent = _TANGENT @ fit
    nearest = (offset * offset).sum(axis=2).argmin(axis=1)
    rows = np.arange(len(marks))
    offset, tangent = offset[rows, nearest], tangent[rows, nearest]
    # Outlines go round so that the region lies to their left, as seen with y down.
    across = tangent[:, 1] * offset[:, 0] - tangent[:, 0] * offset[:, 1]
    return np.asarray(across / np.maximum(np.sqrt((tangent * tangent).sum(axis=1)), 1e-9), np.float64)
