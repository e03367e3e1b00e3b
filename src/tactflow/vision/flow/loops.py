"""Compiled loops over the markers of a frame, and over the cells of the gel that lie in a region."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats, Floats32, Indices, Mask, Points
from tactflow.vision.compiled import helper, kernel
from tactflow.vision.types import MarkerStatus

Sums = NDArray[np.int32]

_TRACKED: Final = int(MarkerStatus.TRACKED)
MOVED_X, MOVED_Y, COEFFICIENT_X, COEFFICIENT_Y, VARIANCE, PRECISION = range(6)
"""Rows of what `weigh_markers` finds for each marker."""
COEFFICIENTS: Final = slice(COEFFICIENT_X, COEFFICIENT_Y + 1)
"""Both rows of coefficients."""
SHARE, MOTION_X, MOTION_Y, WEIGHT, WEIGHT_X, WEIGHT_Y = range(6)
"""Planes of what is computed of each cell."""
_LEAST: Final = 1e-5
"""Precision of a marker given all others, 1, at least: one that no other is near. Chosen by hand."""
_NOWHERE: Final = 1e-12
"""Sum of the kernel between a region and all markers, at least, to divide by. Chosen by hand."""


@kernel(
    "Tuple((float64, float64))(float64[:, ::1], uint8[::1], float64[::1], float64[:, ::1], int64[:, ::1],"
    " float64, float64, float64, float64[:, ::1])"
)
def rate_motion(
    position: Points,
    status: Mask,
    stderr: Floats,
    rest: Floats,
    links: Indices,
    deviations: float,
    variance: float,
    resting: float,
    rated: Floats,
) -> tuple[float, float]:
    """How far beyond chance the markers of a chain of three neighbours have moved against the whole gel.

    Returns the third largest motion, px, and the largest multiple of its threshold that each marker of a
    chain reaches.

    position : (N, 2), px. status : (N,), of `MarkerStatus`. stderr : (N,), px, NaN where unknown.
    rest : (6, N), of each marker in the reference: x and y, and its arm, x and y from the middle of all, px;
    the arm over its square, 1/px.
    links : (L, 2), neighbours. deviations : threshold, standard deviations. variance : of markers of an
    untouched gel, px^2. resting : motion up to which a marker of a released gel is at rest, px.
    rated : (5, N), filled: what a shift and a turn of the whole gel leave of each tracked marker's motion,
    px, 0 of others, and of all where fewer than three are tracked; its threshold, px; each motion over its
    threshold, 0 at rest or where the error is unknown; the two largest of these among its neighbours.
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
                bounds[count] = x if part == 0 else y if part == 1 else y * rest[4, i] - x * rest[5, i]
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
def _median(values: Floats, count: int) -> float:
    """The median of the first ones, whose order it changes, by Hoare's selection.

    With `np.median`, the kernel takes twice as long to compile.
    """
    upper = count // 2
    first, last = 0, count - 1
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
    " float64[:, ::1], float64[:, ::1])"
)
def weigh_markers(
    position: Points,
    rest: Floats,
    seen: Flags,
    stderr: Floats,
    usual: float,
    largest: float,
    inverse: Floats,
    planes: Floats,
    removed: Floats,
) -> int:
    """The coefficients of a displacement field; returns how many rows of `removed` there are, S.

    position : (N, 2), px. rest : (2, N), in the reference, px. seen : (N,). stderr : (N,), px, NaN or
    infinite where unknown. usual : instead of an unknown one, px. largest : of a marker that counts in full,
    px.
    inverse : (N, N), of the kernel between markers, symmetric.
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
    # First without all that are left out, for the variance of the field to compare errors with.
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
    inverse: Floats, seen: Flags, planes: Floats, largest: float, scale: float, removed: Floats
) -> int:
    """Fill rows of `removed`, see `weigh_markers`, by Cholesky's factors; returns how many.

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
    "void(int32[:, ::1], int64, int64, float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1],"
    " float64[:, ::1], float64[:, ::1], float64[::1])"
)
def sum_region(
    covered: Sums,
    left: int,
    top: int,
    place: Floats,
    planes: Floats,
    to_markers: Floats,
    between: Floats,
    inverse: Floats,
    removed: Floats,
    sums: Floats,
) -> None:
    """Sums over the cells of a region.

    covered : (h + 1, w + 1), sums over the pixels above and to the left in a part of a mask with 255 inside.
    They may overflow: differences are right. left, top : where that part begins, px.
    place : (5,), of the grid: x and y of its first cell, the spacing of its cells, how much farther they may
    have moved than any marker, and the side of the square that counts around each cell, a whole number, px.
    planes, inverse, removed : of `weigh_markers`; of the last, the rows that are filled.
    to_markers : (R, C, N), kernel between cells and markers. between : (2 R - 1, 2 C - 1), kernel between two
    cells, by how many rows and columns they are apart.
    sums : (27,) of 0, filled: how much of each cell is in the region; then, of cells weighted by their share
    in the region: mean m (x, y); a a' (xx, xy, yy), a r' (xx, xy, yx, yy) and r r', where a is the way from
    the middle to a cell and r what its motion is beyond the mean; a times the slope of r along a (x, y); of
    all cells share (1 - share); over pairs of cells, the kernel times 1, and times a a' of the two (xx, xy,
    yy); at the end those of `_sum_markers`. All are 0 without a cell."""
    # The cells whose gel may be in the part.
    least_x, most_x = _extent(planes[MOVED_X], place[3])
    least_y, most_y = _extent(planes[MOVED_Y], place[3])
    height, width = covered.shape[0] - 1, covered.shape[1] - 1
    row = _within((top - place[1] - most_y) / place[2], to_markers.shape[0])
    column = _within((left - place[0] - most_x) / place[2], to_markers.shape[1])
    rows = _within((top + height - place[1] - least_y) / place[2] + 2, to_markers.shape[0]) - row
    columns = _within((left + width - place[0] - least_x) / place[2] + 2, to_markers.shape[1]) - column
    cells, begin = np.empty((6, rows, columns)), (row, column)
    x, y = place[0] + column * place[2] - left, place[1] + row * place[2] - top
    _sample_cells(covered, x, y, place[2], int(place[4]), planes, to_markers, begin, cells)
    for i in range(rows):
        for j in range(columns):
            sums[0] += cells[SHARE, i, j]
    if sums[0] > 0:
        to_region = np.empty((3, planes.shape[1]))
        to_region[:] = 0
        _sum_cells(cells, to_markers, begin, place[2], sums, to_region)
        for i in range(rows):
            for j in range(i + 1):
                # In the cell's own row, each pair comes twice.
                _sum_pairs(cells, i, j, between[between.shape[0] // 2 + j - i], 1.0 if i == j else 2.0, sums)
        _sum_markers(to_region, inverse, removed, planes, sums)


@helper
def _outwards(values: Floats, row: int, column: int, across: float, down: float) -> float:
    """How much a value changes along the way (across, down) from a cell, by its neighbours; in cells."""
    left, right = max(column - 1, 0), min(column + 1, values.shape[1] - 1)
    above, below = max(row - 1, 0), min(row + 1, values.shape[0] - 1)
    along_x = (values[row, right] - values[row, left]) / max(right - left, 1)
    along_y = (values[below, column] - values[above, column]) / max(below - above, 1)
    return float(across * along_x + down * along_y)


@helper
def _sample_cells(
    covered: Sums,
    x: float,
    y: float,
    spacing: float,
    side: int,
    planes: Floats,
    to_markers: Floats,
    begin: tuple[int, int],
    cells: Floats,
) -> None:
    """Fill SHARE and MOTION of `cells`, (6, r, c): how much of each is in the region, and how it has moved,
    px.

    x, y : of the first cell from the corner of the covered part, px. begin : row and column
    of that cell in the grid.
    """
    for row in range(cells.shape[1]):
        for column in range(cells.shape[2]):
            near, across, down = to_markers[begin[0] + row, begin[1] + column], 0.0, 0.0
            for n in range(near.size):
                across += near[n] * planes[COEFFICIENT_X, n]
                down += near[n] * planes[COEFFICIENT_Y, n]
            cells[MOTION_X, row, column], cells[MOTION_Y, row, column] = across, down
            here_x, here_y = x + column * spacing + across, y + row * spacing + down
            cells[SHARE, row, column] = _share(covered, here_x, here_y, side)


@helper
def _sum_cells(
    cells: Floats,
    to_markers: Floats,
    begin: tuple[int, int],
    spacing: float,
    sums: Floats,
    to_region: Floats,
) -> None:
    """The sums of `sum_region` over single cells, from the second on.

    cells : of `_sample_cells`; WEIGHT is filled with the share of each, in sum 1, and that times a_x and a_y.
    to_region : (3, N) of 0, filled with the kernel between the region and the markers, times 1, a_x and a_y.
    """
    total, x, y, u, v = sums[0], 0.0, 0.0, 0.0, 0.0
    for row in range(cells.shape[1]):
        for column in range(cells.shape[2]):
            share = cells[SHARE, row, column] / total
            x, y = x + share * column, y + share * row
            u, v = u + share * cells[MOTION_X, row, column], v + share * cells[MOTION_Y, row, column]
    sums[1], sums[2] = u, v
    for row in range(cells.shape[1]):
        for column in range(cells.shape[2]):
            share = cells[SHARE, row, column] / total
            across, down = spacing * (column - x), spacing * (row - y)
            right, below = cells[MOTION_X, row, column] - u, cells[MOTION_Y, row, column] - v
            at_x, at_y = share * across, share * down
            cells[WEIGHT, row, column], cells[WEIGHT_X, row, column], cells[WEIGHT_Y, row, column] = (
                share,
                at_x,
                at_y,
            )
            if share == 0:
                continue
            sums[3] += at_x * across
            sums[4] += at_x * down
            sums[5] += at_y * down
            sums[6] += at_x * right
            sums[7] += at_x * below
            sums[8] += at_y * right
            sums[9] += at_y * below
            sums[10] += share * (right * right + below * below)
            sums[11] += share * _outwards(cells[MOTION_X], row, column, across, down) / spacing
            sums[12] += share * _outwards(cells[MOTION_Y], row, column, across, down) / spacing
            sums[13] += share * total * (1 - share * total)
            near = to_markers[begin[0] + row, begin[1] + column]
            for n in range(near.size):
                to_region[0, n] += share * near[n]
                to_region[1, n] += at_x * near[n]
                to_region[2, n] += at_y * near[n]


@helper
def _extent(moved: Floats, margin: float) -> tuple[float, float]:
    """Least and largest motion along an axis, wider by a margin."""
    least = most = moved[0]
    for n in range(1, moved.size):
        least, most = min(least, moved[n]), max(most, moved[n])
    return least - margin, most + margin


@helper
def _within(value: float, high: int) -> int:
    """The whole number below, in 0 to `high`."""
    return int(min(max(value, 0.0), float(high)))


@helper
def _share(covered: Sums, x: float, y: float, side: int) -> float:
    """How much of a square is covered, 0 to 1; a pixel that it cuts through counts by what lies in it."""
    height, width = covered.shape[0] - 1, covered.shape[1] - 1
    x, y = x + 0.5 - 0.5 * side, y + 0.5 - 0.5 * side
    if not (-side < x < width and -side < y < height):
        return 0.0
    column, row, total = math.floor(x), math.floor(y), 0.0
    for down in range(2):
        top, bottom = min(max(row + down, 0), height), min(max(row + down + side, 0), height)
        for across in range(2):
            left, right = min(max(column + across, 0), width), min(max(column + across + side, 0), width)
            upper = covered[top, right] - covered[top, left]
            inside = np.int32(covered[bottom, right] - covered[bottom, left] - upper)
            total += abs(1 - down - (y - row)) * abs(1 - across - (x - column)) * inside
    return total / (255.0 * side * side)


@helper
def _sum_pairs(cells: Floats, row: int, other: int, kernel_row: Floats, times: float, sums: Floats) -> None:
    """Add what the cells of two rows have in common to the sums over pairs of `sum_region`."""
    columns = cells.shape[2]
    ones, along, downwards = cells[WEIGHT, row], cells[WEIGHT_X, row], cells[WEIGHT_Y, row]
    for column in range(columns):
        one = cells[WEIGHT, other, column]
        if one == 0:
            continue
        across, down = cells[WEIGHT_X, other, column], cells[WEIGHT_Y, other, column]
        near = kernel_row[kernel_row.size // 2 - column :]
        with_one = with_x = with_y = 0.0
        for k in range(columns):
            with_one += ones[k] * near[k]
            with_x += along[k] * near[k]
            with_y += downwards[k] * near[k]
        sums[14] += times * one * with_one
        sums[15] += times * across * with_x
        sums[16] += times * (across * with_y + down * with_x) / 2
        sums[17] += times * down * with_y


@helper
def _sum_markers(to_region: Floats, inverse: Floats, removed: Floats, planes: Floats, sums: Floats) -> None:
    """The last nine sums of `sum_region`, for the standard errors of a region's mean motion and slopes.

    to_region : (3, N), kernel between the region and the markers, times 1, a_x and a_y.
    Variance of the field near the region, px^2; then of 1 and 1, x and x, x and y, y and y: the part of the
    variance that the markers determine, relative; what their own errors add to it, px^2.
    """
    count, weights = planes.shape[1], np.empty_like(to_region)
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
                weights[0, n] -= one * row[n]
                weights[1, n] -= x * row[n]
                weights[2, n] -= y * row[n]
    near = squares = 0.0
    for i in range(count):
        x, y, variance = planes[COEFFICIENT_X, i], planes[COEFFICIENT_Y, i], planes[VARIANCE, i]
        squares += to_region[0, i] * planes[PRECISION, i] * (x * x + y * y)
        near += to_region[0, i] if planes[PRECISION, i] > 0 else 0.0
        one, x, y = weights[0, i], weights[1, i], weights[2, i]
        sums[19] += one * to_region[0, i]
        sums[20] += x * to_region[1, i]
        sums[21] += x * to_region[2, i]
        sums[22] += y * to_region[2, i]
        sums[23] += variance * one * one
        sums[24] += variance * x * x
        sums[25] += variance * x * y
        sums[26] += variance * y * y
    sums[18] = squares / max(near, _NOWHERE)


@kernel("void(float64[:, ::1], Array(uint8, 2, 'C', readonly=True), boolean[::1])")
def look_up(points: Points, mask: Mask, inside: Flags) -> None:
    """Which points (N, 2), px, fall on a pixel of a mask that is not 0; none outside of it does."""
    for i in range(len(points)):
        x, y = np.rint(points[i, 0]), np.rint(points[i, 1])
        within = 0 <= x < mask.shape[1] and 0 <= y < mask.shape[0]
        inside[i] = within and mask[int(y), int(x)] != 0


@kernel(
    "int64(float32[:, :, ::1], float64[::1], float64, float32[:, ::1], float32[:, ::1], float32[:, :, ::1],"
    " int64[::1], float32[:, ::1], float64[::1])"
)
def compare_light(
    change: Floats32,
    warp: Floats,
    gain: float,
    away: Floats32,
    light: Floats32,
    by: Floats32,
    patches: Indices,
    error: Floats32,
    sums: Floats,
) -> int:
    """How the light of a picture differs from that of a template that has moved; returns how many cells are
    seen, of which neither the border nor a marker hides a part.

    change : (h, w, 4), of `light_change`. warp : (4,): scale times cosine and sine of the turn, and where the
    centre is, cells. gain : factor of the light. away, light, by, patches : of a template.
    error : (N, 3), filled: picture less template, 0 where it is not seen. sums : (10,), filled: `by` times
    the error; its square; the squares of its sums over patches; the error of each channel.
    """
    count, patch = 0, np.zeros(3)
    sums[:] = 0
    for i in range(len(away)):
        if i > 0 and patches[i] != patches[i - 1]:
            sums[6] += patch[0] ** 2 + patch[1] ** 2 + patch[2] ** 2
            patch[:] = 0
        error[i] = 0
        x = warp[0] * away[i, 0] - warp[1] * away[i, 1] + warp[2]
        y = warp[1] * away[i, 0] + warp[0] * away[i, 1] + warp[3]
        if not (0 <= x < change.shape[1] - 1 and 0 <= y < change.shape[0] - 1):
            continue
        column, row = int(x), int(y)
        upper, lower = change[row, column : column + 2], change[row + 1, column : column + 2]
        if min(upper[0, 3], upper[1, 3], lower[0, 3], lower[1, 3]) < 1:
            continue
        count += 1
        right, down = x - column, y - row
        for channel in range(3):
            above = upper[0, channel] + right * (upper[1, channel] - upper[0, channel])
            below = lower[0, channel] + right * (lower[1, channel] - lower[0, channel])
            left = above + down * (below - above) - gain * light[i, channel]
            error[i, channel] = left
            patch[channel] += left
            sums[5] += left * left
            sums[7 + channel] += left
            for k in range(5):
                sums[k] += by[i, channel, k] * left
    sums[6] += patch[0] ** 2 + patch[1] ** 2 + patch[2] ** 2
    return count
