"""Compiled loops of `displacement_field`: which cells of the gel lie in a region, and sums over them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Sums = NDArray[np.int32]

_NOWHERE: Final = 1e-12
"""Kernel between a region and all markers, in sum, of a region that is far from each. Chosen by hand."""


@kernel(
    "void(int32[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[::1], int64[::1], float64[::1],"
    " float64[:, ::1])",
    reorder=True,
)
def sample_region(
    covered: Sums,
    to_markers: FloatArray,
    coefficients: FloatArray,
    place: FloatArray,
    window: IntArray,
    inside: FloatArray,
    moved: FloatArray,
) -> None:
    """How cells of a grid have moved, and how much of the surroundings of each is now in a region.

    covered : (h + 1, w + 1), sums over the pixels above and to the left in the part of a mask with 255 inside
    that bounds the region. They may overflow: differences are right.
    to_markers : (R, C, N), kernel between the grid's cells and the markers. coefficients : (2, N), of the
    field. place : of the first cell of a window, and the spacing of its cells: x and y from that part's
    corner, px.
    window : its first row and column in the grid, every how many cells, its columns, and the side of the
    square around a cell that counts, px. inside, moved : (n,) and (n, 2), of its cells row by row, filled.
    """
    columns, side = window[3], window[4]
    along_x, along_y = coefficients[0], coefficients[1]
    for k in range(inside.size):
        i, j = k // columns, k % columns
        near = to_markers[window[0] + window[2] * i, window[1] + window[2] * j]
        x = y = 0.0
        for n in range(near.size):
            x += near[n] * along_x[n]
            y += near[n] * along_y[n]
        moved[k, 0], moved[k, 1] = x, y
        # The left and upper end of the square, from the outer corner of the part.
        x = place[0] + place[2] * j + x + 0.5 - 0.5 * side
        y = place[1] + place[2] * i + y + 0.5 - 0.5 * side
        inside[k] = 0.0
        if -side < x < covered.shape[1] - 1 and -side < y < covered.shape[0] - 1:
            inside[k] = _square(covered, x, y, side) / (255.0 * side * side)


@helper
def _square(covered: Sums, x: float, y: float, side: int) -> float:
    """The sum over a square that cuts through pixels; each counts by what of it lies in the square."""
    column, row = math.floor(x), math.floor(y)
    right, below = x - column, y - row
    upper = _box(covered, row, column, side) * (1 - right) + _box(covered, row, column + 1, side) * right
    row += 1
    lower = _box(covered, row, column, side) * (1 - right) + _box(covered, row, column + 1, side) * right
    return float(upper * (1 - below) + lower * below)


@helper
def _box(covered: Sums, row: int, column: int, side: int) -> float:
    """The sum over whole pixels."""
    height, width = covered.shape[0] - 1, covered.shape[1] - 1
    top, bottom = min(max(row, 0), height), min(max(row + side, 0), height)
    left, right = min(max(column, 0), width), min(max(column + side, 0), width)
    upper = covered[top, right] - covered[top, left]
    return float(np.int32(covered[bottom, right] - covered[bottom, left] - upper))


@kernel(
    "void(float64[::1], float64[:, ::1], float64[:, :, ::1], int64[::1], float64, float64[:, ::1],"
    " float64[::1], float64[:, ::1], float64[:, ::1])",
    reorder=True,
)
def sum_region(
    inside: FloatArray,
    moved: FloatArray,
    to_markers: FloatArray,
    window: IntArray,
    spacing: float,
    table: FloatArray,
    sums: FloatArray,
    weights: FloatArray,
    to_region: FloatArray,
) -> None:
    """Sums over the cells of a region, for its mean motion and its slopes.

    inside, moved, to_markers, window : of `sample_region`. spacing : of the window's cells, px.
    table : (R, 2 C - 1), kernel between cells so many rows and columns apart, the latter from 1 - C on.
    sums : (17,) of 0, filled. Cells count by their share in the region, in sum 1; a is the way from the
    region's middle to a cell, m a cell's motion, r what it has beyond the mean. The shares themselves; mean m
    (x, y); a a' (xx, xy, yy); a r' (xx, xy, yx, yy); r r'; what cells at the outline have of r^2 (x, y); over
    pairs of cells, the kernel times 1, and times a a' of the two (xx, xy, yy). All are 0 without a cell.
    weights : (3, n), filled with the share of each cell, and that times a_x and a_y.
    to_region : (3, N) of 0, filled with the kernel between the region and the markers, times 1, a_x and a_y.
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
    if total == 0:
        return
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
    _sum_pairs(weights, table, columns, sums[13:])


@helper
def _sum_pairs(weights: FloatArray, table: FloatArray, columns: int, sums: FloatArray) -> None:
    """What the cells of a region have in common: the last four sums of `sum_region`."""
    ones, across, down = weights[0], weights[1], weights[2]
    middle = table.shape[1] // 2
    for row in range(ones.size // columns):
        start = row * columns
        first, end = 0, columns
        while first < end and ones[start + first] == 0:
            first += 1
        while first < end and ones[start + end - 1] == 0:
            end -= 1
        for other in range(start + columns if first < end else 0):
            if ones[other] == 0:
                continue
            # In the cell's own row, each pair comes twice.
            count = 1.0 if other >= start else 2.0
            near = table[row - other // columns, middle - other % columns :]
            with_one = with_x = with_y = 0.0
            for k in range(first, end):
                with_one += ones[start + k] * near[k]
                with_x += across[start + k] * near[k]
                with_y += down[start + k] * near[k]
            sums[0] += count * ones[other] * with_one
            sums[1] += count * across[other] * with_x
            sums[2] += count * (across[other] * with_y + down[other] * with_x) / 2
            sums[3] += count * down[other] * with_y


@kernel(
    "void(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1],"
    " float64[::1], float64[:, ::1], float64[::1])",
    reorder=True,
)
def sum_markers(
    to_region: FloatArray,
    inverse: FloatArray,
    rows: FloatArray,
    lost: FloatArray,
    coefficients: FloatArray,
    precision: FloatArray,
    variance: FloatArray,
    weights: FloatArray,
    sums: FloatArray,
) -> None:
    """Sums over the markers, for the standard errors of a region's mean motion and slopes.

    to_region : (3, N), of `sum_region`. inverse : (N, N), of the kernel between markers, symmetric; it is
    less by rows.T @ lost, each (S, N), S >= 0. coefficients : (2, N), of the field.
    precision : (N,), 1 over twice the variance of each marker given all others, relative to the field's; 0
    for markers that are not seen. variance : (N,), of their own errors, px^2.
    weights : (3, N), filled with to_region times the inverse.
    sums : (9,) of 0, filled. Variance of the field near the region, px^2; then of 1 and 1, x and x, x and y,
    y and y: what the markers tell of the variance, relative; what their own errors add to it, px^2.
    """
    count = variance.size
    for i in range(count + len(rows)):
        row = inverse[i] if i < count else rows[i - count]
        one = x = y = 0.0
        for n in range(count):
            one += row[n] * to_region[0, n]
            x += row[n] * to_region[1, n]
            y += row[n] * to_region[2, n]
        if i < count:
            weights[0, i], weights[1, i], weights[2, i] = one, x, y
        else:
            for n in range(count):
                weights[0, n] -= one * lost[i - count, n]
                weights[1, n] -= x * lost[i - count, n]
                weights[2, n] -= y * lost[i - count, n]
    near = squares = 0.0
    for i in range(variance.size):
        x, y = coefficients[0, i], coefficients[1, i]
        squares += to_region[0, i] * precision[i] * (x * x + y * y)
        near += to_region[0, i] if precision[i] > 0 else 0.0
        one, x, y = weights[0, i], weights[1, i], weights[2, i]
        sums[1] += one * to_region[0, i]
        sums[2] += x * to_region[1, i]
        sums[3] += x * to_region[2, i]
        sums[4] += y * to_region[2, i]
        sums[5] += variance[i] * one * one
        sums[6] += variance[i] * x * x
        sums[7] += variance[i] * x * y
        sums[8] += variance[i] * y * y
    sums[0] = squares / max(near, _NOWHERE)
