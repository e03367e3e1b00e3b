"""Compiled loop of `outline`: what it computes is written with numpy there."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Double = NDArray[np.float64]

SIDE: Final = 1.5
"""How much of the outline to each side of a gap takes part in its bridge, in half widths of the gap. Less,
and the pixels' stairs tilt it; more, and it cuts corners."""
ALONG: Final = np.linspace(0, 1, 12)
"""Where the points of a side lie that are taken, from the gap outwards."""
RIDGE: Final = (1e-9, 1e-6, 1e-6)
"""Added to the squares of the fit: a trace that keeps a side of a few points solvable."""
TIE: Final = 1e-6
"""Of two bridges at the same distance but for so much, px, that one counts which has the mark outside: both
sides of a line that is one pixel wide."""
_APART: Final = math.sqrt(2) + 1e-9


@kernel("void(float64[:, ::1], uint8[:, ::1], int32[:, ::1], int64[:, ::1], float64, float64, float64[::1])")
def outline_depths(
    points: Double,
    mask: NDArray[np.uint8],
    outlines: NDArray[np.int32],
    lines: NDArray[np.int64],
    hidden: float,
    reach: float,
    depth: Double,
) -> None:
    """Set the `depth` of each point, as `outline.outline_depth` returns it.

    outlines : (n, 2) px, closed, one after the other. lines : (2, k), for each of them how many steps to a
    neighbouring pixel its points are apart, and how many it has.
    """
    left = right = outlines[0, 0]
    top = bottom = outlines[0, 1]
    for index in range(outlines.shape[0]):
        left, right = min(left, outlines[index, 0]), max(right, outlines[index, 0])
        top, bottom = min(top, outlines[index, 1]), max(bottom, outlines[index, 1])
    unit = max(hidden, 1.0)
    for mark in range(points.shape[0]):
        x, y = points[mark, 0], points[mark, 1]
        if not (left - reach < x < right + reach and top - reach < y < bottom + reach):
            depth[mark] = -np.inf
            continue
        nearest, far, bridged = reach * reach, reach, np.inf
        end = 0
        for line in range(lines.shape[1]):
            step, count = lines[0, line], lines[1, line]
            share = 1 / (_APART * step)
            begin, end = end, end + count
            # From a point that is seen on, so that no gap goes round the end.
            first = begin
            while first < end:
                away_x, away_y = x - outlines[first, 0], y - outlines[first, 1]
                if away_x * away_x + away_y * away_y > hidden * hidden:
                    break
                first += 1
            some = first < end
            index = here = first if some else begin
            last = index + count
            before = -1
            while index <= last:
                here = index if index < end else index - count
                away_x, away_y = x - outlines[here, 0], y - outlines[here, 1]
                square = away_x * away_x + away_y * away_y
                if square < nearest:
                    nearest, far = square, max(math.sqrt(square), hidden)
                if square <= hidden * hidden:
                    if before < 0 and some:
                        before = here - 1 if here > begin else end - 1
                    index += 1
                    continue
                chord_x = chord_y = 0.0
                if before >= 0:
                    chord_x = np.float64(outlines[here, 0] - outlines[before, 0])
                    chord_y = np.float64(outlines[here, 1] - outlines[before, 1])
                chord = math.sqrt(chord_x * chord_x + chord_y * chord_y) * unit
                if chord > 0:
                    side = min(SIDE * hidden / step, count / 2 - 1)
                    s1 = s2 = s3 = s4 = s5 = v0 = v1 = v2 = 0.0
                    for sign in (-1, 1):
                        corner = before if sign < 0 else here
                        for out in ALONG:
                            # At most half way round.
                            known = corner + int(np.rint(sign * out * side))
                            known += count if known < begin else -count if known >= end else 0
                            away_x, away_y = outlines[known, 0] - x, outlines[known, 1] - y
                            # Along the chord, and into the region.
                            u = (away_x * chord_x + away_y * chord_y) / chord
                            v = (away_x * chord_y - away_y * chord_x) / chord
                            w = u * u + v * v
                            s1, s2, s3, s4, s5 = s1 + u, s2 + w, s3 + u * u, s4 + u * w, s5 + w * w
                            v0, v1, v2 = v0 + v, v1 + u * v, v2 + w * v
                    # Cholesky's factors without their roots.
                    s0 = 2 * ALONG.size + RIDGE[0]
                    below1, below2 = s1 / s0, s2 / s0
                    d1 = s3 + RIDGE[1] - below1 * s1
                    mixed = s4 - below2 * s1
                    below = mixed / d1
                    d2 = s5 + RIDGE[2] - below2 * s2 - below * mixed
                    v1 -= below1 * v0
                    v2 = (v2 - below2 * v0 - below * v1) / d2
                    v1 = v1 / d1 - below * v2
                    v0 = v0 / s0 - below1 * v1 - below2 * v2
                    slope = 1 + v1 * v1
                    root = math.sqrt(max(slope - 4 * v0 * v2, 0.0))
                    value = -2 * v0 / (math.sqrt(slope) + root) * unit
                    if abs(value + TIE) < abs(bridged + TIE):
                        bridged = value
                before = -1
                # No point that is left out is nearer than the nearest so far, or hidden.
                index += max(1, int((math.sqrt(square) - far) * share))
        if bridged < np.inf:
            depth[mark] = bridged + 0.5
            continue
        column, row = int(np.rint(x)), int(np.rint(y))
        on = 0 <= column < mask.shape[1] and 0 <= row < mask.shape[0] and mask[row, column] != 0
        distance = math.sqrt(nearest) if nearest < reach * reach else np.inf
        depth[mark] = distance + 0.5 if on else 0.5 - distance
