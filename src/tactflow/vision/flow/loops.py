"""Compiled loops over the markers of a frame, and over the cells of the gel that lie in a region."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel
from tactflow.vision.types import MarkerStatus

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Sums = NDArray[np.int32]
BoolArray = NDArray[np.bool_]
Bytes = NDArray[np.uint8]

_TRACKED: Final = int(MarkerStatus.TRACKED)
MOVED_X, MOVED_Y, COEFFICIENT_X, COEFFICIENT_Y, VARIANCE, PRECISION = range(6)
"""Rows of what `weigh_markers` tells of each marker."""
COEFFICIENTS: Final = slice(COEFFICIENT_X, COEFFICIENT_Y + 1)
"""Both rows of coefficients."""
SHARE, MOTION_X, MOTION_Y, WEIGHT, WEIGHT_X, WEIGHT_Y = range(6)
"""Rows of what `sample_region` and `sum_region` tell of each cell."""
_LEAST: Final = 1e-5
"""What the inverse of the kernel must be, 1, at least: a marker whose place all others leave open. Chosen by
hand."""
_NOWHERE: Final = 1e-12
"""Kernel between a region and all markers, in sum, of a region that is far from each. Chosen by hand."""


@kernel(
    "Tuple((float64, float64))(float64[:, ::1], uint8[::1], float64[::1], float64[:, ::1], int64[:, ::1],"
    " float64, float64, float64, float64[:, ::1])"
)
def rate_motion(
    position: FloatArray,
    status: Bytes,
    stderr: FloatArray,
    rest: FloatArray,
    links: IntArray,
    deviations: float,
    variance: float,
    resting: float,
    rated: FloatArray,
) -> tuple[float, float]:
    """How far beyond chance the markers of a chain of three neighbours have moved against the whole gel.

    Returns the third largest motion, px, and the largest number that each marker of a chain reaches.

    position : (N, 2), px. status : (N,), of `MarkerStatus`. stderr : (N,), px, NaN where unknown.
    rest : (6, N), of each marker in the reference: x and y, and its arm, x and y from the middle of all, px;
    the arm over its square, 1/px.
    links : (L, 2), neighbours. deviations : standard deviations that are a motion. variance : of markers of
    an untouched gel, px^2. resting : the motion up to which a marker of a released gel is at rest, px.
    rated : (5, N), filled: what a shift and a turn of the whole gel leave of each tracked marker's motion,
    px, 0 of others, and of all where fewer than three are; what it takes to be a motion, px; each motion in
    this unit, 0 where it is at rest or its error unknown; the largest and the second largest of these
    numbers among a marker's neighbours.
    """
    left, bounds, ratio, largest, second_largest = rated[0], rated[1], rated[2], rated[3], rated[4]
    shift_x = shift_y = middle = 0.0
    # The shift by x and by y, then the turn: each marker's motion across its arm, over the arm's length.
    for part in range(3):
        # Not simply 0: for a constant, numba would compile `_median` a second time.
        count: Any = np.int64(0)
        for i in range(status.size):
            if status[i] == _TRACKED:
                x, y = position[i, 0] - rest[0, i] - shift_x, position[i, 1] - rest[1, i] - shift_y
                turn = y * rest[4, i] - x * rest[5, i]
                bounds[count] = x if part == 0 else y if part == 1 else turn
                count += 1
        middle = _median(bounds, count) if count else 0.0
        shift_x, shift_y = middle if part == 0 else shift_x, middle if part == 1 else shift_y
    most = second = third = chain = 0.0
    for i in range(left.size):
        x = position[i, 0] - rest[0, i] - shift_x + middle * rest[3, i]
        y = position[i, 1] - rest[1, i] - shift_y - middle * rest[2, i]
        left[i] = math.sqrt(x * x + y * y) if status[i] == _TRACKED and count >= 3 else 0.0
        third = max(third, min(left[i], second))
        second = max(second, min(left[i], most))
        most = max(most, left[i])
        bound = deviations * math.sqrt(stderr[i] * stderr[i] + variance)
        # Nothing is larger than NaN.
        bounds[i], ratio[i] = bound, left[i] / bound if left[i] > resting and bound > 0 else 0.0
        largest[i] = second_largest[i] = 0.0
    for k in range(len(links)):
        for end in range(2):
            i, other = links[k, end], ratio[links[k, 1 - end]]
            second_largest[i] = max(second_largest[i], min(other, largest[i]))
            largest[i] = max(largest[i], other)
    for i in range(left.size):
        chain = max(chain, min(ratio[i], second_largest[i]))
    return third, chain


@helper
def _median(values: FloatArray, count: int) -> float:
    """The median of the first ones, of which it changes the order.

    The same as `np.median`, with which the kernel takes twice as long to compile.
    """
    upper = count // 2
    first, last = 0, count - 1
    # Hoare's selection: what is smaller than the value in the middle goes to its left, what is larger to its
    # right, until nothing is left to be told apart there.
    while first < last:
        middle, i, j = values[upper], first, last
        while i <= j:
            while values[i] < middle:
                i += 1
            while values[j] > middle:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        first, last = i if j < upper else first, j if i > upper else last
    lower = values[upper if count % 2 else 0]
    for i in range(0 if count % 2 else upper):
        lower = max(lower, values[i])
    return float(lower + values[upper]) / 2


@kernel(
    "int64(float64[:, ::1], float64[:, ::1], boolean[::1], float64[::1], float64, float64, float64[:, ::1],"
    " float64[:, ::1], float64[:, ::1])",
    reorder=True,
)
def weigh_markers(
    position: FloatArray,
    rest: FloatArray,
    seen: BoolArray,
    stderr: FloatArray,
    usual: float,
    largest: float,
    inverse: FloatArray,
    planes: FloatArray,
    removed: FloatArray,
) -> int:
    """The coefficients of a displacement field; how many rows of `removed` there are, S.

    position : (N, 2), px. rest : (2, N), in the reference, px. seen : (N,). stderr : (N,), px, NaN or
    infinite where unknown. usual : what stands for an unknown one, px. largest : of a marker that counts in
    full, px. inverse : (N, N), of the kernel between markers, symmetric.
    planes : (6, N), filled. MOVED: the displacements, px, 0 where unseen. COEFFICIENT: their products with
    the inverse, which is without the markers that are not seen, and with the variance of those that are seen
    poorly. VARIANCE: squares of the standard errors, px^2. PRECISION: 1 over twice the variance of each
    marker given all others, relative to the field's, 0 where unseen.
    removed : (N, N), of which S rows are filled: the inverse is less by their squares, removed.T @ removed.
    """
    energy, along = 0.0, np.empty((2, seen.size))
    for i in range(seen.size):
        error = stderr[i] if seen[i] and math.isfinite(stderr[i]) else usual
        planes[MOVED_X, i] = position[i, 0] - rest[0, i] if seen[i] else 0.0
        planes[MOVED_Y, i] = position[i, 1] - rest[1, i] if seen[i] else 0.0
        planes[VARIANCE, i] = error * error
    for i in range(seen.size):
        x = y = 0.0
        for n in range(seen.size):
            x += inverse[i, n] * planes[MOVED_X, n]
            y += inverse[i, n] * planes[MOVED_Y, n]
        planes[COEFFICIENT_X, i], planes[COEFFICIENT_Y, i], planes[PRECISION, i] = x, y, inverse[i, i]
        energy += x * planes[MOVED_X, i] + y * planes[MOVED_Y, i]
    # First without all that are left out: that tells the variance of the field to compare errors with.
    count, scale = 0, 0.0
    for _ in range(2):
        count = _remove(inverse, seen, planes, largest, scale, removed)
        scale = energy
        for s in range(count):
            x = y = 0.0
            for n in range(seen.size):
                x += removed[s, n] * planes[MOVED_X, n]
                y += removed[s, n] * planes[MOVED_Y, n]
            along[0, s], along[1, s] = x, y
            scale -= x * x + y * y
        scale = scale / (2 * (seen.size - count)) if count < seen.size else 0.0
    for s in range(count):
        for n in range(seen.size):
            planes[COEFFICIENT_X, n] -= along[0, s] * removed[s, n]
            planes[COEFFICIENT_Y, n] -= along[1, s] * removed[s, n]
            planes[PRECISION, n] -= removed[s, n] * removed[s, n]
    for i in range(seen.size):
        planes[PRECISION, i] = 0.5 / max(planes[PRECISION, i], _LEAST) if seen[i] else 0.0
    return count


@helper
def _remove(
    inverse: FloatArray,
    seen: BoolArray,
    planes: FloatArray,
    largest: float,
    scale: float,
    removed: FloatArray,
) -> int:
    """Fill rows of `removed`, see `weigh_markers`, by Cholesky's factors; how many.

    scale : variance of the field, px^2, for markers that are seen poorly; 0 leaves them out altogether.
    """
    count = 0
    for i in range(seen.size):
        if seen[i] and planes[VARIANCE, i] <= largest * largest:
            continue
        for n in range(seen.size):
            removed[count, n] = inverse[i, n]
        for s in range(count):
            factor = removed[s, i]
            for n in range(seen.size):
                removed[count, n] -= factor * removed[s, n]
        factor = 1 / math.sqrt(removed[count, i] + (scale / planes[VARIANCE, i] if seen[i] else 0.0))
        for n in range(seen.size):
            removed[count, n] *= factor
        count += 1
    return count


@kernel(
    "void(int32[:, ::1], int64, int64, float64[::1], float64[:, ::1], float64[:, :, ::1], int64[::1],"
    " float64[:, ::1])",
    reorder=True,
)
def sample_region(
    covered: Sums,
    left: int,
    top: int,
    place: FloatArray,
    planes: FloatArray,
    to_markers: FloatArray,
    window: IntArray,
    cells: FloatArray,
) -> None:
    """How cells of a grid have moved, and how much of the surroundings of each is now in a region.

    covered : (h + 1, w + 1), sums over the pixels above and to the left in the part of a mask with 255 inside
    that bounds the region. They may overflow: differences are right. left, top : where that part begins, px.
    place : (5,), of the grid: x and y of its first cell, the spacing of its cells, how much farther they may
    have moved than any marker, and the side of the square that counts around each cell, a whole number, px.
    planes : (6, N), of `weigh_markers`. to_markers : (R, C, N), kernel between the grid's cells and the
    markers.
    window : (4,), filled: the first row and column of the cells that may be in the region, and how many rows
    and columns of them there are.
    cells : (6, R C), of which three rows are filled from the beginning on, for these cells row by row. SHARE:
    of each in the region. MOTION: px; both are 0 for those whose gel cannot be in the region.
    """
    height, width, side = covered.shape[0] - 1, covered.shape[1] - 1, int(place[4])
    first_x, first_y, spacing, margin = place[0], place[1], place[2], place[3]
    # The cells whose gel may be in the part, and for each of them where its gel may be.
    least_x, most_x = _extent(planes, MOVED_X, margin)
    least_y, most_y = _extent(planes, MOVED_Y, margin)
    first_row = _within((top - first_y - most_y) / spacing, to_markers.shape[0])
    first_column = _within((left - first_x - most_x) / spacing, to_markers.shape[1])
    end_row = _within((top + height - first_y - least_y) / spacing + 2, to_markers.shape[0])
    end_column = _within((left + width - first_x - least_x) / spacing + 2, to_markers.shape[1])
    rows, columns = end_row - first_row, end_column - first_column
    window[0], window[1], window[2], window[3] = first_row, first_column, rows, columns
    for k in range(rows * columns):
        cells[SHARE, k] = cells[MOTION_X, k] = cells[MOTION_Y, k] = 0.0
    for row in range(rows):
        for column in range(columns):
            i, j, k = first_row + row, first_column + column, row * columns + column
            x, y = first_x + spacing * j - left, first_y + spacing * i - top
            up, down = _within(y + least_y, height), _within(y + most_y + 1, height)
            if not _box(covered, up, _within(x + least_x, width), down, _within(x + most_x + 1, width)):
                continue
            u = v = 0.0
            for n in range(planes.shape[1]):
                u += to_markers[i, j, n] * planes[COEFFICIENT_X, n]
                v += to_markers[i, j, n] * planes[COEFFICIENT_Y, n]
            cells[MOTION_X, k], cells[MOTION_Y, k] = u, v
            # The left and upper end of the square, from the outer corner of the part.
            x, y = x + u + 0.5 - 0.5 * side, y + v + 0.5 - 0.5 * side
            if -side < x < width and -side < y < height:
                cells[SHARE, k] = _square(covered, x, y, side) / (255.0 * side * side)


@helper
def _extent(travelled: FloatArray, axis: int, margin: float) -> tuple[float, float]:
    """Of all motions along an axis, wider by a margin."""
    least = most = travelled[axis, 0]
    for n in range(1, travelled.shape[1]):
        least, most = min(least, travelled[axis, n]), max(most, travelled[axis, n])
    return least - margin, most + margin


@helper
def _within(value: float, high: int) -> int:
    """The whole number below, in 0 to `high`."""
    return int(min(max(value, 0.0), float(high)))


@helper
def _square(covered: Sums, x: float, y: float, side: int) -> float:
    """The sum over a square that cuts through pixels; each counts by what of it lies in the square."""
    column, row, total = math.floor(x), math.floor(y), 0.0
    for down in range(2):
        for across in range(2):
            part = abs(1 - down - (y - row)) * abs(1 - across - (x - column))
            top, left = row + down, column + across
            total += part * _box(covered, top, left, top + side, left + side)
    return total


@helper
def _box(covered: Sums, top: int, left: int, bottom: int, right: int) -> int:
    """The sum over whole pixels."""
    height, width = covered.shape[0] - 1, covered.shape[1] - 1
    top, bottom = min(max(top, 0), height), min(max(bottom, 0), height)
    left, right = min(max(left, 0), width), min(max(right, 0), width)
    upper = covered[top, right] - covered[top, left]
    return int(np.int32(covered[bottom, right] - covered[bottom, left] - upper))


@kernel(
    "void(float64[:, ::1], float64[:, :, ::1], int64[::1], float64, float64[:, ::1], float64[::1],"
    " float64[:, ::1])",
    reorder=True,
)
def sum_region(
    cells: FloatArray,
    to_markers: FloatArray,
    window: IntArray,
    spacing: float,
    table: FloatArray,
    sums: FloatArray,
    to_region: FloatArray,
) -> None:
    """Sums over the cells of a region, for its mean motion and its slopes.

    cells, to_markers, window : of `sample_region`. Of cells, three more rows are filled. WEIGHT: the share of
    each, in sum 1; WEIGHT_X and WEIGHT_Y: that times a_x and a_y. spacing : of the cells, px.
    table : (R, 2 C - 1), kernel between cells so many rows and columns apart, the latter from 1 - C on.
    sums : (26,) of 0, filled up to the 17th. Cells count by their share in the region, in sum 1; a is the way
    from the middle to a cell, m its motion, r what that is beyond the mean. The shares; mean m (x, y); a a'
    (xx, xy, yy); a r' (xx, xy, yx, yy); r r'; what cells at the outline have of r^2 (x, y); over pairs of
    cells, the kernel times 1, and times a a' of the two (xx, xy, yy). All are 0 without a cell.
    to_region : (3, N) of 0, filled with the kernel between the region and the markers, times 1, a_x and a_y.
    """
    total = x = y = u = v = 0.0
    first_row, first_column, rows, columns = window[0], window[1], window[2], window[3]
    for row in range(rows):
        for column in range(columns):
            k = row * columns + column
            share = cells[SHARE, k]
            total += share
            x, y = x + share * column, y + share * row
            u, v = u + share * cells[MOTION_X, k], v + share * cells[MOTION_Y, k]
    if total == 0:
        return
    x, y, u, v = x / total, y / total, u / total, v / total
    sums[0], sums[1], sums[2] = total, u, v
    for row in range(rows):
        for column in range(columns):
            k = row * columns + column
            share = cells[SHARE, k] / total
            across, down = spacing * (column - x), spacing * (row - y)
            right, below = cells[MOTION_X, k] - u, cells[MOTION_Y, k] - v
            at_x, at_y = share * across, share * down
            cells[WEIGHT, k], cells[WEIGHT_X, k], cells[WEIGHT_Y, k] = share, at_x, at_y
            if share == 0:
                continue
            edge = cells[SHARE, k] * (1 - cells[SHARE, k])
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
            near = to_markers[first_row + row, first_column + column]
            for n in range(near.size):
                to_region[0, n] += share * near[n]
                to_region[1, n] += at_x * near[n]
                to_region[2, n] += at_y * near[n]
    _sum_pairs(cells, table, rows, columns, sums)


@helper
def _sum_pairs(cells: FloatArray, table: FloatArray, rows: int, columns: int, sums: FloatArray) -> None:
    """What the cells of a region have in common: the last four sums of `sum_region`."""
    middle = table.shape[1] // 2
    # Of each row, the first cell that counts, and the one behind the last.
    ends = np.empty((rows, 2), np.int64)
    for row in range(rows):
        first, end = row * columns, row * columns + columns
        while first < end and cells[WEIGHT, first] == 0:
            first += 1
        while first < end and cells[WEIGHT, end - 1] == 0:
            end -= 1
        ends[row, 0], ends[row, 1] = first - row * columns, end - row * columns
        for before in range(row + 1 if first < end else 0):
            # In the cell's own row, each pair comes twice.
            times = 1.0 if before == row else 2.0
            for column in range(ends[before, 0], ends[before, 1]):
                other = before * columns + column
                one, across, down = cells[WEIGHT, other], cells[WEIGHT_X, other], cells[WEIGHT_Y, other]
                with_one = with_x = 0.0
                for k in range(first, end):
                    near = table[row - before, middle - column + k - row * columns]
                    with_one += cells[WEIGHT, k] * near
                    with_x += cells[WEIGHT_X, k] * near
                # All cells of a row are equally far down.
                with_y = with_one * cells[WEIGHT_Y, first] / cells[WEIGHT, first]
                sums[13] += times * one * with_one
                sums[14] += times * across * with_x
                sums[15] += times * (across * with_y + down * with_x) / 2
                sums[16] += times * down * with_y


@kernel(
    "void(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1])",
    reorder=True,
)
def sum_markers(
    to_region: FloatArray,
    inverse: FloatArray,
    removed: FloatArray,
    planes: FloatArray,
    weights: FloatArray,
    sums: FloatArray,
) -> None:
    """Sums over the markers, for the standard errors of a region's mean motion and slopes.

    to_region : (3, N), of `sum_region`. inverse : (N, N), of the kernel between markers, symmetric; it is
    less by removed.T @ removed, (S, N), S >= 0. planes : (6, N), of `weigh_markers`.
    weights : (3, N), filled with to_region times the inverse.
    sums : (26,), from the 18th on filled. Variance of the field near the region, px^2; then of 1 and 1, x and
    x, x and y, y and y: what the markers tell of the variance, relative; what their own errors add to it,
    px^2.
    """
    count = planes.shape[1]
    for i in range(count + len(removed)):
        row = inverse[i] if i < count else removed[i - count]
        one = x = y = 0.0
        for n in range(count):
            one += row[n] * to_region[0, n]
            x += row[n] * to_region[1, n]
            y += row[n] * to_region[2, n]
        if i < count:
            weights[0, i], weights[1, i], weights[2, i] = one, x, y
        else:
            for n in range(count):
                weights[0, n] -= one * removed[i - count, n]
                weights[1, n] -= x * removed[i - count, n]
                weights[2, n] -= y * removed[i - count, n]
    near = squares = 0.0
    for i in range(count):
        x, y, variance = planes[COEFFICIENT_X, i], planes[COEFFICIENT_Y, i], planes[VARIANCE, i]
        squares += to_region[0, i] * planes[PRECISION, i] * (x * x + y * y)
        near += to_region[0, i] if planes[PRECISION, i] > 0 else 0.0
        one, x, y = weights[0, i], weights[1, i], weights[2, i]
        sums[18] += one * to_region[0, i]
        sums[19] += x * to_region[1, i]
        sums[20] += x * to_region[2, i]
        sums[21] += y * to_region[2, i]
        sums[22] += variance * one * one
        sums[23] += variance * x * x
        sums[24] += variance * x * y
        sums[25] += variance * y * y
    sums[17] = squares / max(near, _NOWHERE)


@kernel("void(float64[:, ::1], uint8[:, ::1], boolean[::1])")
def look_up(points: FloatArray, mask: Bytes, inside: NDArray[np.bool_]) -> None:
    """Which points (N, 2), px, fall on a pixel of a mask that is not 0; none outside of it does."""
    for i in range(len(points)):
        x, y = np.rint(points[i, 0]), np.rint(points[i, 1])
        within = 0 <= x < mask.shape[1] and 0 <= y < mask.shape[0]
        inside[i] = within and mask[int(y), int(x)] != 0
