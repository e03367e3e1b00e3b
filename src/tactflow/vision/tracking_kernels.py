"""Loops of `MarkerTracker`, for numba."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@kernel(
    "int64(float64[:, ::1], float64[:, ::1], float64[:, ::1], float32[::1], float32[::1], int64[:, ::1],"
    "float64[::1], float64[::1], boolean[::1], float64, float64, boolean[::1], float64[::1])"
)
def judge(
    position: FloatArray,
    before: FloatArray,
    origin: FloatArray,
    gain: NDArray[np.float32],
    share: NDArray[np.float32],
    edges: IntArray,
    length: FloatArray,
    accepted: FloatArray,
    seen_before: BoolArray,
    longest: float,
    restless: float,
    seen: BoolArray,
    stretch: FloatArray,
) -> int:
    """What `MarkerTracker._judge` finds out, into `seen` and `stretch`; returns the doubt.

    longest : step of a mark that is seen, px. restless : step that calls for a search where something is
    missing, px.
    """
    missing = lost = rough = False
    farthest = steepest = 0.0
    for n in range(len(position)):
        move_x, move_y = position[n, 0] - before[n, 0], position[n, 1] - before[n, 1]
        move = np.sqrt(move_x * move_x + move_y * move_y)
        trusted = gain[n] > np.float32(0.2) and gain[n] < np.float32(3.0) and share[n] > np.float32(0.5)
        seen[n] = trusted and move < longest
        if seen[n]:
            farthest = max(farthest, move)
        else:
            missing = True
            lost = lost or seen_before[n]
    for e in range(len(edges)):
        one, other = edges[e, 0], edges[e, 1]
        change_x = (position[one, 0] - origin[one, 0]) - (position[other, 0] - origin[other, 0])
        change_y = (position[one, 1] - origin[one, 1]) - (position[other, 1] - origin[other, 1])
        stretch[e] = np.sqrt(change_x * change_x + change_y * change_y) / length[e]
        steepest = max(steepest, stretch[e])
        if stretch[e] > 0.7 or stretch[e] > max(0.4, accepted[e] + 0.15):
            rough = rough or (seen[one] and seen[other])
    if lost or rough:
        return 2
    if not missing and steepest < 0.4:
        return 0
    return 2 if farthest > restless else 1


@kernel("void(boolean[::1], float64[::1], int64[::1], int64[:, ::1], int64[::1], int64[::1], boolean[::1])")
def largest_part(
    seen: BoolArray,
    stretch: FloatArray,
    first: IntArray,
    links: IntArray,
    weights: IntArray,
    island: IntArray,
    settled: BoolArray,
) -> None:
    """What `MarkerTracker._largest_part` finds. first : (N + 1,) where each mark's part of links begins;
    links : (2 E, 2), the neighbour and the number of the edge."""
    count = len(seen)
    waiting = seen.copy()
    # The marks of a part, one part after the other.
    order = np.empty(count, np.int64)
    heaviest = np.zeros(count, np.int64)
    begin, end = np.zeros(count, np.int64), np.zeros(count, np.int64)
    filled = 0
    for seed in range(count):
        if not waiting[seed]:
            continue
        waiting[seed] = False
        start = filled
        order[filled] = seed
        filled += 1
        weight = 0
        next_mark = start
        while next_mark < filled:
            mark = order[next_mark]
            next_mark += 1
            weight += weights[mark]
            for link in range(first[mark], first[mark + 1]):
                other = links[link, 0]
                if waiting[other] and stretch[links[link, 1]] < 0.3:
                    waiting[other] = False
                    order[filled] = other
                    filled += 1
        home = island[seed]
        if weight > heaviest[home]:
            heaviest[home], begin[home], end[home] = weight, start, filled
    settled[:] = False
    for home in range(count):
        for number in range(begin[home], end[home]):
            settled[order[number]] = True
