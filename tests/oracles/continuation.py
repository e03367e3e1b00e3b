"""Plain version of the kernel that continues an outline below markers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.continuation import CUBICS, INWARD, TANGENT, TURN, continue_outline
from tests.oracles.gains import Gain


def plain_continue_outline(
    outline: NDArray[np.int32], hidden: NDArray[np.uint8], line: NDArray[np.int32]
) -> int:
    """All hidden parts at once; returns the number of points, 0 or -1 as the kernel does."""
    below = hidden[outline[:, 1], outline[:, 0]] > 0
    unseen = np.count_nonzero(below)
    if unseen == 0:
        return -1
    if unseen == len(below):
        return 0
    # Begin behind a hidden part, so that no seen part is cut in two.
    start = int(np.argmax(below < np.roll(below, 1)))
    below = np.concatenate([below[start:], below[:start], below[start : start + 1]])
    points = np.concatenate([outline[start:], outline[:start]]).astype(np.float64)
    count = len(points)
    # The first point is seen, so a change is in turn the first hidden one of a part and the first behind it.
    change = np.flatnonzero(below[1:] != below[:-1]) + 1
    first, behind = change[::2], change[1::2]
    since = np.maximum(first - 1 - TANGENT, np.concatenate([[0], behind[:-1]]))
    until = np.minimum(behind + TANGENT, np.concatenate([first[1:], [count + first[0]]]) - 1)
    before, after = points[first - 1], points[behind % count]
    chord = after - before
    square = np.einsum("ij,ij->i", chord, chord)
    # Directions at both ends, as long as the chord, and the cosines of their angles to it.
    ways = np.stack([before - points[since], points[until % count] - after])
    ways *= np.sqrt(square / np.maximum(np.einsum("kij,kij->ki", ways, ways), 1e-9))[..., None]
    along = np.einsum("kij,ij->ki", ways, chord) / np.maximum(square, 1e-9)
    ahead = along.min(axis=0) > TURN
    # With tangents of this length, equal angles at both ends make a curve as high as the circle's arc.
    ways *= (4 / np.maximum(2 + along.sum(axis=0), 1))[:, None]
    ways[:, ~ahead] = chord[~ahead]
    curves = CUBICS @ np.stack([before, ways[0], after, ways[1]], axis=1)
    inwards = chord[:, ::-1] * (INWARD, -INWARD) / np.sqrt(np.maximum(square, 1))[:, None]
    curves += inwards[:, None]
    pieces, last = [], 0
    for curve, left, back in zip(curves, first.tolist(), behind.tolist(), strict=True):
        pieces += [points[last:left], curve]
        last = back
    pieces.append(points[last:])
    found = np.rint(np.concatenate(pieces))
    line[: len(found)] = found
    return len(found)


# Points half way between pixels may be rounded either way.
GAINS = [Gain(continue_outline, plain_continue_outline, tolerance=1, scratch=("line",))]
