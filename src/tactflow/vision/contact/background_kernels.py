"""Compiled loops of `comparison`: what they compute is written with numpy and OpenCV there.

Pictures of several channels come as planes, (3, h, w), which vectorise; interleaved ones as (h, 3 w).
Neighbours beyond the border are those mirrored about the last pixel, as OpenCV takes them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Float = NDArray[np.float32]
Double = NDArray[np.float64]
Byte = NDArray[np.uint8]


@kernel("void(uint8[:, ::1], float32[:, :, ::1])")
def smooth_cells(cells: Byte, smooth: Float) -> None:
    """Means over 3 x 3 cells, plane by plane.

    cells : (h, 3 w). smooth : (3, h, w), filled.
    """
    high, wide = smooth.shape[1:]
    sums = np.empty(3 * wide, np.uint16)
    ninth = np.float32(1 / 9)
    for y in range(high):
        above = min(1, high - 1) if y == 0 else y - 1
        below = max(high - 2, 0) if y == high - 1 else y + 1
        upper, line, lower = cells[above], cells[y], cells[below]
        for x in range(3 * wide):
            sums[x] = np.uint16(upper[x]) + np.uint16(line[x]) + np.uint16(lower[x])
        for channel in range(3):
            row, part = smooth[channel, y], sums[channel:]
            inner = row[1:]
            for x in range(wide - 2):
                inner[x] = np.float32(part[3 * x] + part[3 * x + 3] + part[3 * x + 6]) * ninth
            last = wide - 1
            row[0] = np.float32(part[0] + 2 * part[3 * min(1, last)]) * ninth
            row[last] = np.float32(part[3 * last] + 2 * part[3 * max(last - 1, 0)]) * ninth


@kernel(
    "void(float32[:, :, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1])",
    reorder=True,
)
def coarse_excess(planes: Float, by_rows: Float, by_columns: Float, usual: Float, excess: Float) -> None:
    """Means over blocks of each plane, less the usual ones.

    planes : (3, h, w). by_rows : (rows, h) and by_columns : (columns, w), parts of each block. usual : (3,
    rows * columns). excess : the same, filled.
    """
    high, wide = planes.shape[1:]
    rows, columns = len(by_rows), len(by_columns)
    line = np.empty(wide, np.float32)
    for c in range(3):
        for row in range(rows):
            line[:] = 0
            for y in range(row * high // rows, min(((row + 1) * high - 1) // rows + 1, high)):
                part, plane = by_rows[row, y], planes[c, y]
                for x in range(wide):
                    line[x] += part * plane[x]
            for column in range(columns):
                total = np.float32(0)
                first, last = column * wide // columns, min(((column + 1) * wide - 1) // columns + 1, wide)
                for x in range(first, last):
                    total += by_columns[column, x] * line[x]
                excess[c, row * columns + column] = total - usual[c, row * columns + column]


@kernel(
    "void(float32[:, ::1], float32[:, :, ::1], float32[:, :, ::1], float32[:, :, ::1], float32[:, ::1],"
    " int64, float32, float32[:, ::1])",
    reorder=True,
)
def fit_light(
    excess: Float,
    basis: Float,
    solve: Float,
    shrink: Float,
    limit: Float,
    rounds: int,
    settled: float,
    found: Float,
) -> None:
    """Steps of least squares with clipped residuals; `found`, (3, 4), holds the start and then the result.

    excess, limit : (3, n). basis, solve : (3, 4, n). shrink : (3, 4, 4), all per channel.
    """
    step = np.empty(4, np.float32)
    for _ in range(rounds):
        longest = np.float32(0)
        for c in range(3):
            f0, f1, f2, f3 = found[c, 0], found[c, 1], found[c, 2], found[c, 3]
            s0 = s1 = s2 = s3 = np.float32(0)
            for i in range(excess.shape[1]):
                known = f0 * basis[c, 0, i] + f1 * basis[c, 1, i] + f2 * basis[c, 2, i] + f3 * basis[c, 3, i]
                rest = min(max(excess[c, i] - known, -limit[c, i]), limit[c, i])
                s0 += rest * solve[c, 0, i]
                s1 += rest * solve[c, 1, i]
                s2 += rest * solve[c, 2, i]
                s3 += rest * solve[c, 3, i]
            step[0], step[1], step[2], step[3] = s0, s1, s2, s3
            for k in range(4):
                for j in range(4):
                    step[k] -= (f0, f1, f2, f3)[j] * shrink[c, j, k]
            for k in range(4):
                found[c, k] += step[k]
                longest = max(longest, abs(step[k]))
        if longest < settled:
            break


@kernel(
    "void(float32[:, :, ::1], float32[:, ::1], float32[::1], float32[::1], float32[:, :, ::1],"
    " float32[:, :, ::1], float32[:, :, ::1], float32[:, :, ::1], float32[:, ::1], uint8[:, ::1],"
    " float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1], float64[::1])",
    reorder=True,
)
def weigh_change(
    smooth: Float,
    found: Float,
    across: Float,
    down: Float,
    mean: Float,
    shade: Float,
    weight: Float,
    grey: Float,
    sharper: Float,
    before: Byte,
    then: Float,
    square: Float,
    colour: Float,
    evidence: Float,
    summary: Double,
) -> None:
    """Squared deviations of each cell from the reference under the light of this frame.

    smooth, mean, shade, weight, grey : (3, h, w). found : (3, 4). across, down : positions, (w,) and (h,).
    before : (h, w), cells in contact in the frame before, and then : the evidence there; both (0, 0) if none.
    square, colour, evidence : (h, w), and summary : largest square, largest colour, sums of the evidence over
    `before`, now and then; filled.
    """
    high, wide = square.shape
    squares = np.full(wide, -np.inf, np.float32)
    colours = np.full(wide, -np.inf, np.float32)
    along = np.empty(wide, np.float32)
    now = was = 0.0
    for y in range(high):
        total, rest, both = square[y], colour[y], evidence[y]
        for c in range(3):
            offset, slope, gain = found[c, 0] + found[c, 2] * down[y], found[c, 1], found[c, 3]
            line, usual, shadow = smooth[c, y], mean[c, y], shade[c, y]
            scale, tone = weight[c, y], grey[c, y]
            for x in range(wide):
                change = line[x] - (usual[x] + (shadow[x] * gain + (offset + slope * across[x])))
                deviation = change * scale[x]
                total[x] = deviation * deviation + (total[x] if c else np.float32(0))
                along[x] = change * tone[x] + (along[x] if c else np.float32(0))
        for x in range(wide):
            rest[x] = total[x] * sharper[y, x] - along[x] * along[x]
            both[x] = total[x] if total[x] > rest[x] else rest[x]
            squares[x] = squares[x] if squares[x] > total[x] else total[x]
            colours[x] = colours[x] if colours[x] > rest[x] else rest[x]
        if before.size:
            for x in range(wide):
                inside = np.float32(before[y, x])
                now += inside * both[x]
                was += inside * then[y, x]
    summary[0] = summary[1] = -np.inf
    for x in range(wide):
        summary[0] = max(summary[0], squares[x])
        summary[1] = max(summary[1], colours[x])
    summary[2], summary[3] = now, was


@kernel(
    "void(uint8[:, ::1], int64, int64, float32[:, ::1], float32[::1], float32[::1], float32[:, :, ::1],"
    " float32[:, :, ::1], float32[:, :, ::1], uint8[:, ::1], float32, float32,"
    " float32[:, ::1], float32[:, ::1], float64[::1])",
    reorder=True,
)
def relative_change(
    half: Byte,
    top: int,
    left: int,
    found: Float,
    across: Float,
    down: Float,
    mean: Float,
    shade: Float,
    scale: Float,
    inside: Byte,
    beside: float,
    middle: float,
    strength: Float,
    common: Float,
    summary: Double,
) -> None:
    """How strongly a window has changed at half resolution, relative to its brightness, smoothed.

    half : (H, 3 W), the frame. top, left : of the window. found, across, down : as `weigh_change` takes them,
    at this resolution. mean, shade, scale : (3, H, W). inside : (h / 2, w / 2), cells that count. beside,
    middle : weights of smoothing. strength : (h, w), length of the change over the channels; common : (h, w),
    their mean; summary : sum of `common`, sum and sum of squares of `strength`; filled.
    """
    high, wide = strength.shape
    blurred = np.empty((3, high, wide), np.float32)
    line = np.empty(wide, np.float32)
    place = across[left:]
    second, last = min(1, wide - 1), wide - 1
    for y in range(high):
        picture = half[top + y, 3 * left :]
        for c in range(3):
            offset, slope, gain = found[c, 0] + found[c, 2] * down[top + y], found[c, 1], found[c, 3]
            usual, shadow, unit = mean[c, top + y, left:], shade[c, top + y, left:], scale[c, top + y, left:]
            for x in range(wide):
                change = np.float32(picture[3 * x + c]) - usual[x]
                line[x] = (change - (shadow[x] * gain + (offset + slope * place[x]))) * unit[x]
            row = blurred[c, y]
            for x in range(1, wide - 1):
                row[x] = (line[x - 1] + line[x + 1]) * beside + line[x] * middle
            row[0] = (line[second] + line[second]) * beside + line[0] * middle
            before = line[max(last - 1, 0)]
            row[last] = (before + before) * beside + line[last] * middle
    counts = np.empty(wide, np.float32)
    sums = squares = tones = 0.0
    for y in range(high):
        above = min(1, high - 1) if y == 0 else y - 1
        below = max(high - 2, 0) if y == high - 1 else y + 1
        for x in range(wide // 2):
            counts[2 * x] = counts[2 * x + 1] = np.float32(inside[y // 2, x] != 0)
        length, tone = strength[y], common[y]
        for c in range(3):
            upper, here, lower = blurred[c, above], blurred[c, y], blurred[c, below]
            for x in range(wide):
                value = ((upper[x] + lower[x]) * beside + here[x] * middle) * counts[x]
                length[x] = value * value + (length[x] if c else np.float32(0))
                tone[x] = value + (tone[x] if c else np.float32(0))
        third = np.float32(1 / 3)
        for x in range(wide):
            squares += length[x]
            length[x] = np.sqrt(length[x])
            tone[x] *= third
            sums += length[x]
            tones += tone[x]
    summary[0], summary[1], summary[2] = tones, sums, squares


@kernel("void(float32[:, ::1], float32, uint8[:, ::1])")
def close_changes(square: Float, weak: float, closed: Byte) -> None:
    """1 where `square` is above `weak`, after closing by 3 x 3, else 0; `closed` is filled."""
    high, wide = square.shape
    # A rim for each step: what is outside neither grows nor eats.
    grown = np.ones((high + 2, wide + 2), np.uint8)
    above = np.zeros((high + 2, wide + 2), np.uint8)
    line = np.empty(wide + 2, np.uint8)
    for y in range(high):
        row = above[y + 1, 1:]
        for x in range(wide):
            row[x] = np.uint8(square[y, x] > weak)
    for y in range(high):
        upper, here, lower, row = above[y], above[y + 1], above[y + 2], grown[y + 1, 1:]
        for x in range(wide + 2):
            line[x] = upper[x] | here[x] | lower[x]
        for x in range(wide):
            row[x] = line[x] | line[x + 1] | line[x + 2]
    for y in range(high):
        upper, here, lower, row = grown[y], grown[y + 1], grown[y + 2], closed[y]
        for x in range(wide + 2):
            line[x] = upper[x] & here[x] & lower[x]
        for x in range(wide):
            row[x] = line[x] & line[x + 1] & line[x + 2]
