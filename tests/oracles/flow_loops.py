"""Plain versions of the kernels of the displacement field and of the motion of markers."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.displacement_field import matern
from tactflow.vision.flow.loops import (
    look_up,
    rate_motion,
    sample_region,
    sum_markers,
    sum_region,
    weigh_markers,
)
from tests.oracles.gains import Gain
from tests.oracles.typical import Arguments

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def plain_rate_motion(
    position: FloatArray,
    status: NDArray[np.uint8],
    stderr: FloatArray,
    rest: FloatArray,
    links: IntArray,
    deviations: float,
    variance: float,
    resting: float,
    rated: FloatArray,
) -> tuple[float, float]:
    """Medians as complex numbers. A neighbour that has two of its own rank is the middle of three."""
    tracked = np.flatnonzero(status == 0)
    left = np.zeros(len(status))
    if len(tracked) >= 3:
        arms = (rest[2] + 1j * rest[3])[tracked]
        moved = (position @ [1, 1j] - rest[0] - 1j * rest[1])[tracked]
        moved -= np.median(moved.real) + 1j * np.median(moved.imag)
        turn = np.median((moved * arms.conj()).imag / np.maximum(abs(arms) ** 2, 1.0))
        left[tracked] = abs(moved - 1j * turn * arms)
    bound = deviations * np.sqrt(stderr**2 + variance)
    ratio = np.nan_to_num(np.where(left > resting, left / bound, 0.0))
    rated[:3], rated[3:] = (left, bound, ratio), 0.0
    for marker in range(len(left)):
        beside = np.concatenate([links[links[:, 0] == marker, 1], links[links[:, 1] == marker, 0]])
        largest = np.sort(ratio[beside])[::-1][:2]
        rated[3 : 3 + len(largest), marker] = largest
    third = np.sort(left)[-3] if len(left) >= 3 else 0.0
    return float(third), float(np.minimum(ratio, rated[4]).max(initial=0.0))


def plain_weigh_markers(
    position: FloatArray,
    rest: FloatArray,
    seen: NDArray[np.bool_],
    stderr: FloatArray,
    usual: float,
    largest: float,
    inverse: FloatArray,
    planes: FloatArray,
    removed: FloatArray,
) -> int:
    """Products of matrices, and Cholesky's factors of what is left out."""
    moved = np.where(seen, position.T - rest, 0.0)
    error = np.where(seen & np.isfinite(stderr), stderr, usual)
    variance = error**2
    left_out = np.flatnonzero(~seen | (error > largest))
    count, rows = len(left_out), inverse[left_out]
    scale = 0.0
    for _ in range(2):
        certainty = np.where(seen[left_out], scale / np.maximum(variance[left_out], 1e-300), 0.0)
        factors = np.linalg.cholesky(rows[:, left_out] + np.diag(certainty))
        removed[:count] = np.linalg.solve(factors, rows)
        less = inverse - removed[:count].T @ removed[:count]
        scale = float((moved @ less * moved).sum()) / (2 * max(len(seen) - count, 1))
    planes[:2], planes[2:4], planes[4] = moved, moved @ less, variance
    planes[5] = np.where(seen, 0.5 / np.maximum(np.diagonal(less), 1e-5), 0.0)
    return count


def poorly_seen() -> Arguments:
    """Of 40 markers in the plane three are seen poorly, and two are not."""
    rng = np.random.default_rng(3)
    rest, moved = rng.uniform(0, 300, (2, 40)), rng.normal(0, 2, (40, 2))
    distance = np.hypot(*(rest[:, :, None] - rest[:, None, :]))
    seen, stderr = np.ones(40, np.bool_), np.full(40, 0.02)
    seen[[3, 30]], stderr[[7, 11, 20]], stderr[[1, 30]] = False, (0.1, 0.5, 1.0), np.nan
    inverse = np.linalg.inv(matern(distance / 60) + 1e-5 * np.eye(40))
    return (rest.T + moved, rest, seen, stderr, 0.02, 0.06, inverse, np.empty((6, 40)), np.zeros((40, 40)))


def plain_sample_region(
    covered: NDArray[np.int32],
    left: int,
    top: int,
    place: FloatArray,
    planes: FloatArray,
    to_markers: FloatArray,
    window: IntArray,
    cells: FloatArray,
) -> None:
    """Each cell's motion as a product, and its share by sums over squares, interpolated between pixels."""
    height, width = size = np.array(covered.shape) - 1
    spacing, margin, side = place[2], place[3], int(place[4])
    least, most = planes[:2].min(axis=1) - margin, planes[:2].max(axis=1) + margin
    corner = np.array([left, top]) - place[:2]
    begin = np.clip(np.floor((corner - most) / spacing), 0, to_markers.shape[1::-1])
    end = np.clip(np.floor((corner + size[::-1] - least) / spacing) + 2, 0, to_markers.shape[1::-1])
    columns, rows = (end - begin).astype(int).tolist()
    window[:] = *begin[::-1], rows, columns
    count = rows * columns
    down, across = np.divmod(np.arange(count), columns)
    at = begin * spacing - corner + spacing * np.column_stack([across, down])
    (first, top), (last, bottom) = (
        np.clip((at + way).astype(int) + more, 0, (width, height)).T for way, more in ((least, 0), (most, 1))
    )
    there = covered[bottom, last] - covered[bottom, first] - covered[top, last] + covered[top, first] != 0
    moved = _of_window(to_markers, window) @ planes[2:4].T * there[:, None]
    cells[0, :count], cells[1:3, :count] = 0, moved.T
    # Around the region there is nothing. Sums over the squares at each pixel of this.
    total = np.pad(covered.astype(np.int64), side + 1, "edge")
    total[: side + 1], total[:, : side + 1] = 0, 0
    boxes = total[side:, side:] - total[side:, :-side] - total[:-side, side:] + total[:-side, :-side]
    x, y = (at + moved + (1 - side) / 2 + side + 1).T
    here = np.flatnonzero(there & (x >= 0) & (y >= 0) & (x < boxes.shape[1] - 1) & (y < boxes.shape[0] - 1))
    column, row = x[here].astype(int), y[here].astype(int)
    right, below = x[here] - column, y[here] - row
    upper = boxes[row, column] * (1 - right) + boxes[row, column + 1] * right
    lower = boxes[row + 1, column] * (1 - right) + boxes[row + 1, column + 1] * right
    cells[0, here] = (upper * (1 - below) + lower * below) / (255 * side**2)


def _of_window(to_markers: FloatArray, window: IntArray) -> FloatArray:
    """(n, N), kernel between the cells of a window and the markers."""
    top, left, rows, columns = window.tolist()
    chosen: Any = to_markers[top : top + rows, left : left + columns]
    return np.asarray(chosen.reshape(rows * columns, -1))


def plain_sum_region(
    cells: FloatArray,
    to_markers: FloatArray,
    window: IntArray,
    spacing: float,
    table: FloatArray,
    sums: FloatArray,
    to_region: FloatArray,
) -> None:
    """Means and second moments as matrix products; the whole matrix of the kernel between all cells."""
    rows, columns = window[2:].tolist()
    chosen = cells[:, : rows * columns]
    inside, moved, weights = chosen[0], chosen[1:3].T, chosen[3:]
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
    sums[13:17] = common[0, 0], common[1, 1], common[1, 2], common[2, 2]
    to_region[:] = weights @ _of_window(to_markers, window)


def plain_sum_markers(
    to_region: FloatArray,
    inverse: FloatArray,
    removed: FloatArray,
    planes: FloatArray,
    weights: FloatArray,
    sums: FloatArray,
) -> None:
    """Matrix products."""
    coefficients, variance, precision = planes[2:4], planes[4], planes[5]
    weights[:] = to_region @ (inverse - removed.T @ removed)
    near = to_region[0] * (precision > 0)
    sums[17] = near @ (precision * (coefficients**2).sum(axis=0)) / max(near.sum(), 1e-12)
    for first, other in ((18, to_region), (22, weights * variance)):
        form = weights @ other.T
        sums[first : first + 4] = form[0, 0], form[1, 1], form[1, 2], form[2, 2]


def plain_look_up(points: FloatArray, mask: NDArray[np.uint8], inside: NDArray[np.bool_]) -> None:
    """OpenCV's lookup."""
    pixels = np.rint(points).astype(np.float32)
    found = cv2.remap(mask, pixels[:, :1], pixels[:, 1:], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    inside[:] = found[:, 0]


GAINS = [
    Gain(look_up, plain_look_up),
    Gain(rate_motion, plain_rate_motion, tolerance=1e-9),
    Gain(weigh_markers, plain_weigh_markers, tolerance=1e-6, arguments=poorly_seen),
    Gain(sample_region, plain_sample_region, tolerance=1e-9),
    Gain(sum_region, plain_sum_region, tolerance=1e-6),
    Gain(sum_markers, plain_sum_markers, tolerance=1e-6),
]
