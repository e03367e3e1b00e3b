"""Which points lie inside a contact, where markers hide its outline: bridged from what is seen around them.

Under a marker, and next to it, the gel's own light is not seen but filled in. A contact's region has a dent
or a bulge there, however it was found: where the region's own outline is continued below markers, it errs at
them by 0.9 px (scaled median deviation, 11 000 markers of simulated contacts), the bridge by 0.6 px. Whether
a marker at the border is inside must therefore not be asked of the region's pixels below it.
"""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

FloatArray = NDArray[np.float64]
Outline = NDArray[np.int32]

MANY: Final = 400
"""Of an outline with more points, every second is enough: some 400 points still follow it. Chosen by hand."""
SIDE: Final = 1.5
"""How much of the outline to each side of a gap takes part in its bridge, in half widths of the gap. Less,
and the pixels' stairs tilt it; more, and it cuts corners. Chosen by hand."""
ALONG: Final = np.linspace(0, 1, 12)
"""Where the points of a side lie that are taken, from the gap outwards, in parts of the side.
Their number is chosen by hand."""
RIDGE: Final = (1e-9, 1e-6, 1e-6)
"""Added to the squares of the fit: a trace that keeps a side of a few points solvable. Chosen by hand."""
TIE: Final = 1e-6
"""Of two bridges at the same distance but for so much, px, that one counts which has the point outside: both
sides of a line that is one pixel wide. Chosen by hand."""
NEIGHBOUR: Final = math.sqrt(2) + 1e-9
"""Distance of neighbouring pixels of an outline at most, px, rounded up."""


def inside_outline(
    points: NDArray[Any], mask: NDArray[np.uint8], hidden: float, dilate: float = 0.0
) -> NDArray[np.bool_]:
    """Which markers lie inside a region, or at most `dilate` px outside of its outline.

    The circle over a gap is the least-squares fit of its equation, which is linear in three parameters
    (Kasa); one of them is the curvature, so that a line is a circle like others. Computed in float64.

    Parameters
    ----------
    points : (N, 2) float, centres of the markers, px, x right, y down.
    mask : (H, W) uint8, non-zero in the region. A pixel is a square: the outline runs half a pixel outside of
        the centres of the outermost ones.
    hidden : px, >= 0. Outline that is nearer than this to a marker is not trusted for this marker: it is
        replaced by the circle, or line, that fits what is seen of it to both sides. Larger values are safer
        against dents and know less of corners.
    dilate : px, >= 0, to a fraction of a pixel.

    Returns
    -------
    inside : (N,) bool.

    Raises
    ------
    ValueError : mask is not (H, W) uint8, or hidden or dilate is negative or not finite.

    References
    ----------
    I. Kasa, "A circle fitting procedure and its error analysis", IEEE Trans. Instrum. Meas. 25 (1976).

    Examples
    --------
    >>> import numpy as np
    >>> mask = np.zeros((40, 40), np.uint8)
    >>> mask[10:30, 10:30] = 255
    >>> inside_outline(np.array([[20.0, 20.0], [31.0, 20.0]]), mask, hidden=3.0)
    array([ True, False])
    """
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    for name, value in (("hidden", hidden), ("dilate", dilate)):
        if not (value >= 0 and math.isfinite(value)):
            raise ValueError(f"required {name} >= 0 px, got {value}")
    return outline_depth(points, mask, hidden, max(dilate, hidden) + 1) >= -dilate


def outline_depth(points: NDArray[Any], mask: NDArray[np.uint8], hidden: float, reach: float) -> FloatArray:
    """How deep markers lie inside a region: their distance from its outline, px, negative outside.

    points, mask, hidden : as `inside_outline` takes them. reach : px, >= hidden; where the outline is further
    away, a marker is told inf inside, -inf outside. Returns (N,) float64.

    >>> import numpy as np
    >>> mask = np.zeros((40, 40), np.uint8)
    >>> mask[10:30, 10:30] = 255
    >>> outline_depth(np.array([[12.0, 20.0], [2.0, 20.0]]), mask, hidden=0.0, reach=5.0)
    array([ 2.5, -inf])
    """
    depth = np.full(len(points), -np.inf)
    if len(points) == 0 or mask.size == 0:
        return depth
    found = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    if len(found) == 0:
        return depth
    steps = [2 if len(outline) > MANY else 1 for outline in found]
    outlines = [np.asarray(line[::step, 0], np.int32) for line, step in zip(found, steps, strict=True)]
    corners = np.concatenate(outlines) if len(outlines) > 1 else np.ascontiguousarray(outlines[0])
    left, top, width, height = cv2.boundingRect(corners)
    outline_depths(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(mask),
        corners,
        np.array([steps, list(map(len, outlines))]),
        np.array([left - reach, top - reach, left + width - 1 + reach, top + height - 1 + reach]),
        hidden,
        reach,
        depth,
    )
    return depth


@helper
def _bridge(x: float, y: float, outline: Outline, ends: tuple[int, int], side: float, unit: float) -> float:
    """Signed distance of a point from the bridge over a gap in a closed outline, px, positive inside.

    With the point as origin, u along the gap's chord and v into the region, the bridge is the curve
    v = a + b u + c (u^2 + v^2) that fits the outline beside the gap; it is at a distance of
    -2 a / (g + sqrt(g^2 - 4 a c)) with g^2 = 1 + b^2, for c = 0 that from a line. Infinite where both ends
    are the same pixel, which has no direction.

    ends : the seen points next to the gap. side : how many points beside each take part. unit : px, of u, v.
    """
    chord_x = np.float64(outline[ends[1], 0] - outline[ends[0], 0])
    chord_y = np.float64(outline[ends[1], 1] - outline[ends[0], 1])
    chord = math.sqrt(chord_x * chord_x + chord_y * chord_y) * unit
    if not chord > 0:
        return math.inf
    count = len(outline)
    s1 = s2 = s3 = s4 = s5 = a = b = c = 0.0
    for sign in (-1, 1):
        corner = ends[0] if sign < 0 else ends[1]
        for out in ALONG:
            # At most half way round.
            known = corner + int(np.rint(sign * out * side))
            known += count if known < 0 else -count if known >= count else 0
            away_x, away_y = outline[known, 0] - x, outline[known, 1] - y
            u = (away_x * chord_x + away_y * chord_y) / chord
            v = (away_x * chord_y - away_y * chord_x) / chord
            w = u * u + v * v
            s1, s2, s3, s4, s5 = s1 + u, s2 + w, s3 + u * u, s4 + u * w, s5 + w * w
            a, b, c = a + v, b + u * v, c + w * v
    # Cholesky's factors without their roots.
    s0 = 2 * ALONG.size + RIDGE[0]
    below1, below2 = s1 / s0, s2 / s0
    d1 = s3 + RIDGE[1] - below1 * s1
    mixed = s4 - below2 * s1
    below = mixed / d1
    d2 = s5 + RIDGE[2] - below2 * s2 - below * mixed
    b -= below1 * a
    c = (c - below2 * a - below * b) / d2
    b = b / d1 - below * c
    a = a / s0 - below1 * b - below2 * c
    slope = 1 + b * b
    root = math.sqrt(max(slope - 4 * a * c, 0.0))
    return float(-2 * a / (math.sqrt(slope) + root) * unit)


@helper
def _first_seen(x: float, y: float, outline: Outline, hidden: float) -> int:
    """Index of the first point of an outline that is out of a marker's reach; its length if there is none."""
    for index in range(len(outline)):
        away_x, away_y = x - outline[index, 0], y - outline[index, 1]
        if away_x * away_x + away_y * away_y > hidden * hidden:
            return index
    return len(outline)


@kernel(
    "void(float64[:, ::1], uint8[:, ::1], int32[:, ::1], int64[:, ::1], float64[::1], float64, float64,"
    " float64[::1])"
)
def outline_depths(
    points: FloatArray,
    mask: NDArray[np.uint8],
    outlines: Outline,
    lines: NDArray[np.int64],
    box: FloatArray,
    hidden: float,
    reach: float,
    depth: FloatArray,
) -> None:
    """Set the `depth` of each point, as `outline_depth` returns it.

    outlines : (n, 2) px, closed, one after the other. lines : (2, k), for each of them how many pixels its
    points are apart, and how many it has. box : left, top, right, bottom of
    what is within reach. depth : filled with -inf before.
    """
    for marker in range(points.shape[0]):
        x, y = points[marker, 0], points[marker, 1]
        if not (box[0] < x < box[2] and box[1] < y < box[3]):
            continue
        nearest, far, bridged = reach * reach, reach, np.inf
        end = 0
        for line in range(lines.shape[1]):
            step, count = lines[0, line], lines[1, line]
            begin, end = end, end + count
            outline = outlines[begin:end]
            side = min(SIDE * hidden / step, count / 2 - 1)
            # From a point that is seen on, so that no gap goes round the end.
            first = _first_seen(x, y, outline, hidden)
            index = first % count
            last = index + count
            before = -1
            while index <= last:
                here = index if index < count else index - count
                away_x, away_y = x - outline[here, 0], y - outline[here, 1]
                square = away_x * away_x + away_y * away_y
                if square < nearest:
                    nearest, far = square, max(math.sqrt(square), hidden)
                if square <= hidden * hidden:
                    if before < 0 and first < count:
                        before = here - 1 if here > 0 else count - 1
                    index += 1
                    continue
                if before >= 0:
                    distance = _bridge(x, y, outline, (before, here), side, max(hidden, 1.0))
                    if abs(distance + TIE) < abs(bridged + TIE):
                        bridged = distance
                before = -1
                # No point that is left out is nearer than the nearest so far, or hidden.
                index += max(1, int((math.sqrt(square) - far) / (NEIGHBOUR * step)))
        if bridged < np.inf:
            depth[marker] = bridged + 0.5
            continue
        column, row = int(np.rint(x)), int(np.rint(y))
        on = 0 <= column < mask.shape[1] and 0 <= row < mask.shape[0] and mask[row, column] != 0
        distance = math.sqrt(nearest) if nearest < reach * reach else np.inf
        depth[marker] = distance + 0.5 if on else 0.5 - distance
