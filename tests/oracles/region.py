"""Plain versions of the kernels of the displacement field."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.region import sample_region, sum_markers, sum_region
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def plain_sample_region(
    covered: NDArray[np.int32],
    to_markers: FloatArray,
    coefficients: FloatArray,
    place: FloatArray,
    window: IntArray,
    inside: FloatArray,
    moved: FloatArray,
) -> None:
    """Each cell's motion as a product, and its share by sums over squares, interpolated between pixels."""
    columns, side = window[3:].tolist()
    kernel = _of_window(to_markers, window, len(inside) // columns)
    moved[:] = kernel @ coefficients.T
    # Around the region there is nothing. Sums over the squares at each pixel of this.
    total = np.pad(covered.astype(np.int64), side + 1, "edge")
    total[: side + 1], total[:, : side + 1] = 0, 0
    boxes = total[side:, side:] - total[side:, :-side] - total[:-side, side:] + total[:-side, :-side]
    down, across = np.divmod(np.arange(len(inside)), columns)
    x = place[0] + place[2] * across + moved[:, 0] + (1 - side) / 2 + side + 1
    y = place[1] + place[2] * down + moved[:, 1] + (1 - side) / 2 + side + 1
    inside[:] = 0
    here = np.flatnonzero((x >= 0) & (y >= 0) & (x < boxes.shape[1] - 1) & (y < boxes.shape[0] - 1))
    column, row = x[here].astype(int), y[here].astype(int)
    right, below = x[here] - column, y[here] - row
    upper = boxes[row, column] * (1 - right) + boxes[row, column + 1] * right
    lower = boxes[row + 1, column] * (1 - right) + boxes[row + 1, column + 1] * right
    inside[here] = (upper * (1 - below) + lower * below) / (255 * side**2)


def _of_window(to_markers: FloatArray, window: IntArray, rows: int) -> FloatArray:
    """(n, N), kernel between the cells of a window and the markers."""
    top, left, step, columns = window[:4].tolist()
    chosen: Any = to_markers[top : top + step * rows : step, left : left + step * columns : step]
    return np.asarray(chosen.reshape(rows * columns, -1))


def plain_sum_region(
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
    """Means and second moments as matrix products; the whole matrix of the kernel between all cells."""
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
    sums[11:13] = (inside * (1 - inside)) @ (rest * rest)
    kernel = table[abs(down[:, None] - down), table.shape[1] // 2 + across[:, None] - across]
    common = weights @ kernel @ weights.T
    sums[13:] = common[0, 0], common[1, 1], common[1, 2], common[2, 2]
    to_region[:] = weights @ _of_window(to_markers, window, rows)


def plain_sum_markers(
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
    """Matrix products."""
    weights[:] = to_region @ (inverse - rows.T @ lost)
    near = to_region[0] * (precision > 0)
    sums[0] = near @ (precision * (coefficients**2).sum(axis=0)) / max(near.sum(), 1e-12)
    for first, other in ((1, to_region), (5, weights * variance)):
        form = weights @ other.T
        sums[first : first + 4] = form[0, 0], form[1, 1], form[1, 2], form[2, 2]


GAINS = [
    Gain(sample_region, plain_sample_region, tolerance=1e-9),
    Gain(sum_region, plain_sum_region, tolerance=1e-6),
    Gain(sum_markers, plain_sum_markers, tolerance=1e-6),
]
