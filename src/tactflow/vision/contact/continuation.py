"""An outline continued below markers, as cubic curves from what is seen on both sides."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

Mask = NDArray[np.uint8]
Whole = NDArray[np.int32]

TURN: Final = 0.2
"""Least cosine of the angle between an outline beside a marker and the chord below it: where the outline
turns back further, no curve is laid below the marker but the chord itself. Chosen by hand."""

TANGENT: Final = 5
"""Points of an outline over which its direction beside a marker is measured. Chosen by hand."""

INWARD: Final = 1 / 16
"""Part of a pixel by which a continued outline is drawn in, so that halfway is outside on every side."""

STEPS: Final = 24
"""Steps of a continued part, more than it has pixels: lines drawn by OpenCV depend on their direction."""


def _hermite(steps: int) -> NDArray[np.float64]:
    """(steps - 1, 4): Hermite's cubics between start and end, both left out."""
    t = np.arange(1, steps) / steps
    back = 1 - t
    return np.stack([(1 + 2 * t) * back**2, t * back**2, t**2 * (3 - 2 * t), -(t**2) * back], axis=1)


CUBICS: Final = _hermite(STEPS)
"""(23, 4): weights of start, direction there, end and direction there at the points of a continued part."""


def continued(outline: Whole, hidden: Mask) -> Whole | None:
    """An outline, its hidden parts replaced by cubics; None if all is hidden.

    Between the last point before a marker and the first behind it runs the cubic that has the outline's
    direction at both (Hermite); where the outline turns back, which no cubic should guess, a straight line.

    outline : (n, 2) int32, closed, px, points one pixel apart. hidden : (h, w) uint8, not 0 where the outline
    is not seen. Returns (m, 2) int32.
    """
    line = np.empty((len(outline) + len(outline) // 2 * len(CUBICS), 2), np.int32)
    count = continue_outline(outline, hidden, line)
    return outline if count < 0 else line[:count] if count else None


@helper
def _point(outline: Whole, index: int) -> tuple[float, float]:
    """A point of a closed outline, whose indices go round."""
    here = index % len(outline)
    return float(outline[here, 0]), float(outline[here, 1])


@helper
def _directions(
    x0: float, y0: float, x1: float, y1: float, ax: float, ay: float, bx: float, by: float
) -> tuple[float, float, float, float]:
    """Directions of the cubic from (x0, y0) to (x1, y1), of the length that makes it round.

    ax, ay, bx, by : the outline's directions at both ends, of any length.
    """
    chord_x, chord_y = x1 - x0, y1 - y0
    square = chord_x * chord_x + chord_y * chord_y
    # As long as the chord, and the cosines of their angles to it.
    scale = math.sqrt(square / max(ax * ax + ay * ay, 1e-9))
    ax, ay = ax * scale, ay * scale
    scale = math.sqrt(square / max(bx * bx + by * by, 1e-9))
    bx, by = bx * scale, by * scale
    along_a = (ax * chord_x + ay * chord_y) / max(square, 1e-9)
    along_b = (bx * chord_x + by * chord_y) / max(square, 1e-9)
    if min(along_a, along_b) > TURN:
        # With tangents of this length, equal angles at both ends make a curve as high as an arc.
        arc = 4 / max(2 + along_a + along_b, 1.0)
        return ax * arc, ay * arc, bx * arc, by * arc
    return chord_x, chord_y, chord_x, chord_y


@helper
def _lay_cubic(
    x0: float, y0: float, x1: float, y1: float, ax: float, ay: float, bx: float, by: float, line: Whole
) -> None:
    """Fill the first points of `line` with the cubic between two points that has these directions there."""
    chord_x, chord_y = x1 - x0, y1 - y0
    inner = INWARD / math.sqrt(max(chord_x * chord_x + chord_y * chord_y, 1.0))
    for k in range(len(CUBICS)):
        c0, c1, c2, c3 = CUBICS[k, 0], CUBICS[k, 1], CUBICS[k, 2], CUBICS[k, 3]
        x = c0 * x0 + c1 * ax + c2 * x1 + c3 * bx + chord_y * inner
        y = c0 * y0 + c1 * ay + c2 * y1 + c3 * by - chord_x * inner
        line[k, 0], line[k, 1] = int(np.rint(x)), int(np.rint(y))


@kernel("int64(int32[:, ::1], uint8[:, ::1], int32[:, ::1])")
def continue_outline(outline: Whole, hidden: Mask, line: Whole) -> int:
    """Replace the hidden parts of an outline, (n, 2), by cubics; `line` is filled.

    Returns the number of points of the line, 0 if all is hidden, -1 if nothing is. `line` has room for
    n + (n // 2) * 23 points, since each hidden part has a seen point before it.
    """
    count = len(outline)
    below = np.empty(count, np.bool_)
    unseen = 0
    for i in range(count):
        below[i] = hidden[outline[i, 1], outline[i, 0]] != 0
        unseen += below[i]
    if unseen == 0:
        return -1
    if unseen == count:
        return 0
    # Begin behind a hidden part, so that no seen part is cut in two.
    start = 0
    while below[start] or not below[start - 1 if start > 0 else count - 1]:
        start += 1
    filled = at = seen_from = 0
    while at < count:
        here = (start + at) % count
        if not below[here]:
            line[filled, 0], line[filled, 1] = outline[here, 0], outline[here, 1]
            filled += 1
            at += 1
            continue
        behind = at
        while behind < count and below[(start + behind) % count]:
            behind += 1
        # A seen part ends where the next hidden one begins; the last hidden part is followed by the first.
        seen_to = behind + 1
        while seen_to - behind <= TANGENT and not below[(start + seen_to) % count]:
            seen_to += 1
        since, until = max(at - 1 - TANGENT, seen_from), min(behind + TANGENT, seen_to - 1)
        x0, y0 = _point(outline, start + at - 1)
        x1, y1 = _point(outline, start + behind)
        from_x, from_y = _point(outline, start + since)
        to_x, to_y = _point(outline, start + until)
        ways = _directions(x0, y0, x1, y1, x0 - from_x, y0 - from_y, to_x - x1, to_y - y1)
        _lay_cubic(x0, y0, x1, y1, ways[0], ways[1], ways[2], ways[3], line[filled:])
        filled += len(CUBICS)
        seen_from = at = behind
    return filled
