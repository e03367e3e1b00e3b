"""Compiled loops of `displacement_field`: which cells of the gel lie in a region, and sums over them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

FloatArray = NDArray[np.float64]
Sums = NDArray[np.int32]


@helper
def _box(sums: Sums, top: int, left: int, side: int) -> float:
    """The sum over a square of pixels, from sums over all that are above and to the left."""
    upper = sums[top, left + side] - sums[top, left]
    return float(np.int32(sums[top + side, left + side] - sums[top + side, left] - upper))


@kernel(
    "void(float64[:, :, ::1], float64[:, ::1], int32[:, ::1], float64[::1], int64[::1], float64[::1],"
    " float64[:, ::1])",
    reorder=True,
)
def sample_region(
    to_markers: FloatArray,
    coefficients: FloatArray,
    sums: Sums,
    place: FloatArray,
    window: NDArray[np.int64],
    inside: FloatArray,
    moved: FloatArray,
) -> None:
    """How cells of a grid have moved, and how much of the surroundings of each is now in a region.

    to_markers : (R, C, N), kernel between the grid's cells and the markers. coefficients : (2, N), of the
    field. sums : (h + 1, w + 1), over the pixels above and to the left, of a mask with 255 inside; its
    border, as wide as the square around a cell that counts, is 0. They may overflow: differences are right.
    place : of the first cell of a window, and the spacing of its cells: x and y from the mask's corner, px.
    window : its first row and column in the grid, every how many cells, its columns, and the side of the
    square around a cell that counts, px. inside, moved : (n,) and (n, 2), of its cells row by row, filled.
    """
    columns, side = window[3], window[4]
    high, wide = sums.shape[0] - 1, sums.shape[1] - 1
    along_x, along_y = coefficients[0], coefficients[1]
    for k in range(inside.size):
        i, j = k // columns, k % columns
        near = to_markers[window[0] + window[2] * i, window[1] + window[2] * j]
        x = y = 0.0
        for n in range(near.size):
            x += near[n] * along_x[n]
            y += near[n] * along_y[n]
        moved[k, 0], moved[k, 1] = x, y
        # The left and upper end of the square, from the outer corner of the mask; beyond the mask all is 0.
        x = place[0] + place[2] * j + x + 0.5 - 0.5 * side
        y = place[1] + place[2] * i + y + 0.5 - 0.5 * side
        inside[k] = 0.0
        if x < 0 or y < 0 or x >= wide - side or y >= high - side:
            continue
        first, row = int(x), int(y)
        right, below = x - first, y - row
        upper = _box(sums, row, first, side) * (1 - right) + _box(sums, row, first + 1, side) * right
        lower = _box(sums, row + 1, first, side) * (1 - right) + _box(sums, row + 1, first + 1, side) * right
        inside[k] = (upper * (1 - below) + lower * below) / (255.0 * side * side)


@kernel(
    "void(float64[::1], float64[:, ::1], float64[:, :, ::1], int64[::1], float64, float64[::1],"
    " float64[:, ::1], float64[:, ::1])",
    reorder=True,
)
def sum_region(
    inside: FloatArray,
    moved: FloatArray,
    to_markers: FloatArray,
    window: NDArray[np.int64],
    spacing: float,
    sums: FloatArray,
    weights: FloatArray,
    to_region: FloatArray,
) -> None:
    """Sums over the cells of a region, for its mean motion and its slopes.

    inside, moved : (n,) and (n, 2), of the cells of a window, row by row. to_markers : of `sample_region`.
    window : as there. spacing : of the window's cells, px.
    sums : (13,), filled. Cells count by their share in the region, in sum 1; a is the way from the region's
    middle to a cell, m a cell's motion, r what it has beyond the mean. The shares themselves; mean m (x, y);
    a a' (xx, xy, yy); a r' (xx, xy, yx, yy); r r'; what cells at the outline have of r^2 (x, y).
    weights : (3, n), filled with the share of each cell, and that times a_x and a_y.
    to_region : (3, N), filled with the kernel between the region and the markers, times 1, a_x and a_y.
    """
    total = x = y = u = v = 0.0
    columns = window[3]
    for k in range(inside.size):
        share = inside[k]
        total += share
        x += share * (k % columns)
        y += share * (k // columns)
        u += share * moved[k, 0]
        v += share * moved[k, 1]
    x, y, u, v = x / total, y / total, u / total, v / total
    sums[0], sums[1], sums[2] = total, u, v
    for k in range(inside.size):
        share = inside[k] / total
        across, down = spacing * (k % columns - x), spacing * (k // columns - y)
        right, below = moved[k, 0] - u, moved[k, 1] - v
        at_x, at_y = share * across, share * down
        weights[0, k], weights[1, k], weights[2, k] = share, at_x, at_y
        if share == 0:
            continue
        edge = inside[k] * (1 - inside[k])
        sums[3] += at_x * across
        sums[4] += at_x * down
        sums[5] += at_y * down
        sums[6] += at_x * right
        sums[7] += at_x * below
        sums[8] += at_y * right
        sums[9] += at_y * below
        sums[10] += share * (right * right + below * below)
        sums[11] += edge * right * right
        sums[12] += edge * below * below
        near = to_markers[window[0] + window[2] * (k // columns), window[1] + window[2] * (k % columns)]
        for n in range(near.size):
            to_region[0, n] += share * near[n]
            to_region[1, n] += at_x * near[n]
            to_region[2, n] += at_y * near[n]


@kernel("void(float64[:, ::1], float64[:, ::1], float64[::1])", reorder=True)
def sum_pairs(weights: FloatArray, table: FloatArray, sums: FloatArray) -> None:
    """What the cells of a region have in common.

    weights : (3, n), of `sum_region`. table : (r, 2 c - 1), kernel between cells so many rows and columns
    apart, the latter from 1 - c on. sums : (4,), filled with sums over all pairs of cells of the kernel
    times their weights: of 1 and 1, x and x, x and y, y and y.
    """
    columns = (table.shape[1] + 1) // 2
    ones, across, down = weights[0], weights[1], weights[2]
    sums[0] = sums[1] = sums[2] = sums[3] = 0.0
    for i in range(ones.size):
        if ones[i] == 0:
            continue
        one, x, y = ones[i], across[i], down[i]
        row = i // columns
        for other in range(row, table.shape[0]):
            # In the cell's own row, each pair comes twice.
            count = 1.0 if other == row else 2.0
            first, near = other * columns, table[other - row, columns - 1 - i % columns :]
            with_one = with_x = with_y = 0.0
            for k in range(columns):
                with_one += ones[first + k] * near[k]
                with_x += across[first + k] * near[k]
                with_y += down[first + k] * near[k]
            sums[0] += count * one * with_one
            sums[1] += count * x * with_x
            sums[2] += count * (x * with_y + y * with_x) / 2
            sums[3] += count * y * with_y
