"""Plain versions of the kernels of the displacement field."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.region import sample_region, sum_pairs, sum_region
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]


def plain_sample_region(
    to_markers: FloatArray,
    coefficients: FloatArray,
    sums: NDArray[np.int32],
    place: FloatArray,
    window: NDArray[np.int64],
    inside: FloatArray,
    moved: FloatArray,
) -> None:
    """Each cell's motion as a product, and its share by sums over squares, interpolated between pixels."""
    columns, side = window[3:].tolist()
    rows = len(inside) // columns
    kernel = _of_window(to_markers, window, rows)
    moved[:] = kernel @ coefficients.T
    height, width = (size - 1 for size in sums.shape)
    down, across = np.divmod(np.arange(len(inside)), columns)
    x = place[0] + place[2] * across + moved[:, 0] + (1 - side) / 2
    y = place[1] + place[2] * down + moved[:, 1] + (1 - side) / 2
    inside[:] = 0
    here = np.flatnonzero((x >= 0) & (y >= 0) & (x < width - side) & (y < height - side))
    total = sums.astype(np.int64)
    boxes = total[side:, side:] - total[side:, :-side] - total[:-side, side:] + total[:-side, :-side]
    column, row = x[here].astype(int), y[here].astype(int)
    right, below = x[here] - column, y[here] - row
    upper = boxes[row, column] * (1 - right) + boxes[row, column + 1] * right
    lower = boxes[row + 1, column] * (1 - right) + boxes[row + 1, column + 1] * right
    inside[here] = (upper * (1 - below) + lower * below) / (255 * side**2)


def _of_window(to_markers: FloatArray, window: NDArray[np.int64], rows: int) -> FloatArray:
    """(n, N), kernel between the cells of a window and the markers."""
    top, left, step, columns = window[:4].tolist()
    chosen: Any = to_markers[top : top + step * rows : step, left : left + step * columns : step]
    return np.asarray(chosen.reshape(rows * columns, -1))


def plain_sum_region(
    inside: FloatArray,
    moved: FloatArray,
    to_markers: FloatArray,
    window: NDArray[np.int64],
    spacing: float,
    sums: FloatArray,
    weights: FloatArray,
    to_region: FloatArray,
) -> None:
    """Means and second moments as matrix products."""
    columns = int(window[3])
    rows = len(inside) // columns
    share = inside / inside.sum()
    down, across = np.divmod(np.arange(len(inside)), columns)
    points = spacing * np.column_stack([across, down])
    arms, mean = points - share @ points, share @ moved
    rest = moved - mean
    weights[:] = share * np.vstack([np.ones(len(share)), arms.T])
    (xx, xy), (_, yy) = weights[1:] @ arms
    sums[:3] = inside.sum(), *mean
    sums[3:6] = xx, xy, yy
    sums[6:10] = (weights[1:] @ rest).ravel()
    sums[10] = share @ (rest * rest).sum(axis=1)
    sums[11:] = (inside * (1 - inside)) @ (rest * rest)
    to_region[:] = weights @ _of_window(to_markers, window, rows)


def plain_sum_pairs(weights: FloatArray, table: FloatArray, sums: FloatArray) -> None:
    """The whole matrix of the kernel between all cells."""
    rows, columns = table.shape[0], (table.shape[1] + 1) // 2
    down, across = np.divmod(np.arange(rows * columns), columns)
    kernel = table[abs(down[:, None] - down), columns - 1 + across[:, None] - across]
    common = weights @ kernel @ weights.T
    sums[:] = common[0, 0], common[1, 1], common[1, 2], common[2, 2]


GAINS = [
    Gain(sample_region, plain_sample_region, tolerance=1e-9),
    Gain(sum_region, plain_sum_region, tolerance=1e-9),
    Gain(sum_pairs, plain_sum_pairs, tolerance=1e-6),
]
