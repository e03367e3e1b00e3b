"""An outline continued below markers, as cubic curves from what is seen on both sides."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

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
    below = hidden[outline[:, 1], outline[:, 0]] > 0
    unseen = np.count_nonzero(below)
    if unseen == 0:
        return outline
    if unseen == len(below):
        return None
    # Begin behind a hidden part, so that no seen part is cut in two.
    start = int(np.argmax(below < np.roll(below, 1)))
    below = np.concatenate([below[start:], below[:start], below[start : start + 1]])
    points = np.concatenate([outline[start:], outline[:start]]).astype(np.float64)
    # The first point is seen, so a change is in turn the first hidden one of a part and the first behind it.
    change = np.flatnonzero(below[1:] != below[:-1]) + 1
    first, behind = change[::2], change[1::2]
    pieces: list[NDArray[np.float64]] = []
    last = 0
    for curve, left, back in zip(_cubics(points, first, behind), first.tolist(), behind.tolist(), strict=True):
        pieces += [points[last:left], curve]
        last = back
    pieces.append(points[last:])
    return np.rint(np.concatenate(pieces)).astype(np.int32)


def _cubics(
    points: NDArray[np.float64], first: NDArray[np.intp], behind: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(k, 23, 2): the curves over the hidden parts of a closed outline, which begins with a seen point.

    points : (n, 2). first, behind : (k,), index of each part's first point, and of the first one behind it.
    """
    count = len(points)
    # A seen part ends where the next hidden one begins; the last hidden part is followed by the first.
    since = np.maximum(first - 1 - TANGENT, np.concatenate([[0], behind[:-1]]))
    until = np.minimum(behind + TANGENT, np.concatenate([first[1:], [count + first[0]]]) - 1)
    before, after = points[first - 1], points[behind % count]
    chord = after - before
    square = np.einsum("ij,ij->i", chord, chord)
    # Directions at both ends, as long as the chord, and the cosines of their angles to it.
    ways = np.stack([before - points[since], points[until % count] - after])
    ways *= np.sqrt(square / np.maximum(np.einsum("kij,kij->ki", ways, ways), 1e-9))[..., None]
    along = np.einsum("kij,ij->ki", ways, chord) / np.maximum(square, 1e-9)
    turns_back = along.min(axis=0) <= TURN
    # With tangents of this length, equal angles at both ends make a curve as high as the circle's arc.
    ways *= (4 / np.maximum(2 + along.sum(axis=0), 1))[:, None]
    ways[:, turns_back] = chord[turns_back]
    curves = CUBICS @ np.stack([before, ways[0], after, ways[1]], axis=1)
    inwards = chord[:, ::-1] * (INWARD, -INWARD) / np.sqrt(np.maximum(square, 1))[:, None]
    return np.asarray(curves + inwards[:, None])
