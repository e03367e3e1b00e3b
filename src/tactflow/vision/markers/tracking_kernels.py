"""Loops of `MarkerTracker`, for numba."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# These stand here, where numba sees that they have changed, for both ways of computing.
LEAST_GAIN: Final = np.float32(0.2)
MOST_GAIN: Final = np.float32(3.0)
LEAST_SHARE: Final = np.float32(0.5)
"""Of a mark that is seen: its contrast against that in the reference, and how much of it is explained."""
LINKED: Final = 0.3
"""Neighbours whose displacements differ by less than this part of their distance move together."""


@kernel(
    "int64(float64[:, ::1], float64[:, ::1], float64[:, ::1], float32[::1], float32[::1], int64[:, ::1],"
    "float64[::1], float64[::1], boolean[::1], float64, float64, float64, boolean[::1], float64[::1])"
)
def judge(
    position: FloatArray,
    before: FloatArray,
    origin: FloatArray,
    gain: NDArray[np.float32],
    share: NDArray[np.float32],
    edges: IntArray,
    length: FloatArray,
    steepest: FloatArray,
    seen_before: BoolArray,
    longest: float,
    restless: float,
    steep: float,
    seen: BoolArray,
    stretch: FloatArray,
) -> int:
    """What `MarkerTracker._judge` finds out, into `seen` and `stretch`; returns the doubt.

    longest : step of a mark that is seen, px. restless : step that calls for a search where something is
    missing, px. steep, steepest : of the whole field, and of each edge (E,), beyond which there is doubt.
    """
    missing = lost = rough = False
    farthest = most = 0.0
    for n in range(len(position)):
        move_x, move_y = position[n, 0] - before[n, 0], position[n, 1] - before[n, 1]
        move = np.sqrt(move_x * move_x + move_y * move_y)
        trusted = gain[n] > LEAST_GAIN and gain[n] < MOST_GAIN and share[n] > LEAST_SHARE
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
        most = max(most, stretch[e])
        if stretch[e] > steepest[e]:
            rough = rough or (seen[one] and seen[other])
    if lost or rough:
        return 2
    if not missing and most < steep:
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
                if waiting[other] and stretch[links[link, 1]] < LINKED:
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


@kernel("int64(float32[:, ::1], float64, int64, float64[:, ::1], float32[::1])")
def peaks(
    response: NDArray[np.float32], least: float, reach: int, points: FloatArray, height: NDArray[np.float32]
) -> int:
    """What `_Spots._peaks` finds, into `points` and `height`; returns how many there are.

    reach : of the square in which they are the highest. Only as many as there is room for are written.
    """
    count, rows, columns = 0, response.shape[0], response.shape[1]
    half, flat, floor = np.float32(0.5), np.float32(-1e-6), np.float32(least)
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            value = response[row, column]
            if not value > floor:
                continue
            highest = True
            for y in range(max(row - reach, 0), min(row + reach + 1, rows)):
                for x in range(max(column - reach, 0), min(column + reach + 1, columns)):
                    highest = highest and not response[y, x] > value
                if not highest:
                    break
            if not highest:
                continue
            if count < len(points):
                before, after = response[row, column - 1], response[row, column + 1]
                offset = half * (before - after) / min(before + after - (value + value), flat)
                points[count, 0] = column + min(max(offset, -half), half)
                before, after = response[row - 1, column], response[row + 1, column]
                offset = half * (before - after) / min(before + after - (value + value), flat)
                points[count, 1] = row + min(max(offset, -half), half)
                height[count] = value
            count += 1
    return count


@kernel("void(float64[:, ::1], float64[:, ::1], float64, uint8[:, ::1], uint8[:, ::1], boolean[::1])")
def near(
    points: FloatArray,
    others: FloatArray,
    scale: float,
    element: NDArray[np.uint8],
    raster: NDArray[np.uint8],
    found: BoolArray,
) -> None:
    """Which points have one of the others within the element around their cell. raster : zeros, is used up;
    `scale` cells per px."""
    height, width = raster.shape
    for n in range(len(others)):
        column = min(max(int(others[n, 0] * scale + 0.5), 0), width - 1)
        row = min(max(int(others[n, 1] * scale + 0.5), 0), height - 1)
        raster[row, column] = 1
    reach = element.shape[0] // 2
    for n in range(len(points)):
        column = min(max(int(points[n, 0] * scale + 0.5), 0), width - 1)
        row = min(max(int(points[n, 1] * scale + 0.5), 0), height - 1)
        found[n] = False
        for y in range(max(row - reach, 0), min(row + reach + 1, height)):
            for x in range(max(column - reach, 0), min(column + reach + 1, width)):
                if raster[y, x] and element[y - row + reach, x - column + reach]:
                    found[n] = True
