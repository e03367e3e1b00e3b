"""Compiled loops of `inpaint`: what they compute is written with OpenCV there.

A cell is 4 x 4 px. A line of cells has four sections one after another, the sums of the three channels and
the weight, each with a margin of `reach` cells on either side: so one loop serves all of them, and what it
computes across two sections lies in their margins.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Bytes = NDArray[np.uint8]
Float = NDArray[np.float32]
Places = NDArray[np.int64]

_READ = "Array(uint8, 2, 'C', readonly=True)"


@kernel(f"void({_READ}, uint8[::1], uint8[::1], uint8[:, ::1], float32[:, ::1], int64, int64[::1])")
def sum_valid(
    mask: Bytes, either: Bytes, valid: Bytes, half: Bytes, cells: Float, reach: int, masked: Places
) -> None:
    """Sums over the valid ones of each cell's 2 x 2 values at half resolution, and 255 for each as weight.

    mask : (4 h, 4 w). either : (8 h w,) is written over. valid : (4 h w,) becomes 255 where none of 2 x 2 px
    is masked, else 0. half : (2 h, 6 w), the picture; becomes 0 where not valid. cells : (h + 2 reach,
    4 (w + 2 reach)) is filled but for its margins. masked : (h,) becomes how many cells of each line have a
    masked px.
    """
    wide = mask.shape[1]
    for y in range(half.shape[0]):
        upper, lower, line = mask[2 * y], mask[2 * y + 1], either[y * wide :]
        for x in range(wide):
            line[x] = upper[x] | lower[x]
    for at in range(valid.size):
        valid[at] = 0 if either[2 * at] | either[2 * at + 1] else 255
    values = half.reshape(-1)
    for at in range(valid.size):
        values[3 * at] &= valid[at]
        values[3 * at + 1] &= valid[at]
        values[3 * at + 2] &= valid[at]
    height, width = half.shape[0] // 2, wide // 4
    section, full = width + 2 * reach, np.float32(4 * 255)
    for y in range(height):
        upper, lower, line = half[2 * y], half[2 * y + 1], cells[reach + y]
        first, second, third = line[reach:], line[section + reach :], line[2 * section + reach :]
        for x in range(width):
            first[x] = upper[6 * x] + upper[6 * x + 3] + lower[6 * x] + lower[6 * x + 3]
            second[x] = upper[6 * x + 1] + upper[6 * x + 4] + lower[6 * x + 1] + lower[6 * x + 4]
            third[x] = upper[6 * x + 2] + upper[6 * x + 5] + lower[6 * x + 2] + lower[6 * x + 5]
        above, below = valid[4 * y * width :], valid[(4 * y + 2) * width :]
        weight = line[3 * section + reach :]
        for x in range(width):
            weight[x] = above[2 * x] + above[2 * x + 1] + below[2 * x] + below[2 * x + 1]
        count = 0
        for x in range(width):
            count += weight[x] < full
        masked[y] = count


@kernel(
    "int64(float32[:, ::1], int64, int64[::1], int64[::1], float32, float32, "
    "float32[:, ::1], float32[:, ::1])"
)
def sum_windows(
    cells: Float,
    reach: int,
    rows: Places,
    columns: Places,
    far: float,
    least: float,
    lines: Float,
    sums: Float,
) -> int:
    """Binomial windows of 3 x 3 cells plus `far` times windows of 2 reach + 1 cells each way.

    cells : (h + 2 reach, 4 (w + 2 reach)), of `sum_valid`; its margins are filled. rows : (h + 2 reach,) and
    columns : (w + 2 reach,), the row and column of which each one of `cells` is a copy; itself, if not in a
    margin. lines : (3, 4 (w + 2 reach)) is written over. sums : (h, 4 (w + 2 reach)) is filled; each section
    starts with its first cell, and 2 reach values at its end mean nothing. Returns how many weights are below
    `least`.
    """
    section = columns.size
    height, width, long = sums.shape[0], section - 2 * reach, 4 * section
    for y in range(height):
        line = cells[reach + y]
        for start in range(0, long, section):
            part = line[start:]
            for x in range(reach):
                part[x] = part[columns[x]]
                part[reach + width + x] = part[columns[reach + width + x]]
    for y in range(cells.shape[0]):
        if rows[y] != y:
            line, source = cells[y], cells[rows[y]]
            for x in range(long):
                line[x] = source[x]
    # Sums of whole numbers below 2**24 are exact, in whatever order.
    tall, wide, near = lines[0], lines[1], lines[2]
    tall[:] = 0
    for y in range(2 * reach):
        line = cells[y]
        for x in range(long):
            tall[x] += line[x]
    two = np.float32(2)
    few, count = 0, long - 2 * reach
    for y in range(height):
        first, last, out = cells[y], cells[y + 2 * reach], sums[y]
        for x in range(long):
            tall[x] += last[x]
            wide[x] = tall[x]
        for step in range(1, 2 * reach, 2):
            beside = tall[step:]
            for x in range(count):
                wide[x] += beside[x] + beside[x + 1]
        above, here, below = cells[y + reach - 1], cells[y + reach], cells[y + reach + 1]
        for x in range(long):
            near[x] = above[x] + two * here[x] + below[x]
        left, middle, right = near[reach - 1 :], near[reach:], near[reach + 1 :]
        for x in range(count):
            out[x] = left[x] + two * middle[x] + right[x] + far * wide[x]
        weight = out[3 * section :]
        for x in range(width):
            few += weight[x] < least
        for x in range(long):
            tall[x] -= first[x]
    return few


@kernel(f"void({_READ}, int64[::1], float32[:, ::1], int64, float32[::1], uint8[::1], uint8[:, ::1])")
def fill_masked(
    mask: Bytes, masked: Places, sums: Float, section: int, line: Float, fill: Bytes, picture: Bytes
) -> None:
    """Masked px become the sums over their weight, interpolated between the centres of cells.

    mask : (4 h, 4 w). masked : (h,), of `sum_valid`. sums : (h, 4 section), of `sum_windows`; becomes the
    quotients. line : (3 section + 2 or a little more,) and fill : (4 times that,) are written over.
    picture : (4 h, 12 w).
    """
    height, width = sums.shape[0], mask.shape[1] // 4
    for y in range(height):
        weight = sums[y, 3 * section :]
        for x in range(width):
            line[x] = np.float32(255) / weight[x]
        for start in range(0, 3 * section, section):
            part = sums[y, start:]
            for x in range(width):
                part[x] *= line[x]
    most, rest = np.float32(0.75), np.float32(0.25)
    inner = line[1:]
    for y in range(2 * height):
        cell = y // 2
        if masked[cell] == 0:
            continue
        other = max(cell - 1, 0) if y % 2 == 0 else min(cell + 1, height - 1)
        here, beyond = sums[cell], sums[other]
        for x in range(3 * section):
            inner[x] = most * here[x] + rest * beyond[x]
        # Beyond its ends a section goes on as it ends; there is room in the margins.
        for start in range(0, 3 * section, section):
            line[start] = inner[start]
            inner[start + width] = inner[start + width - 1]
        for x in range(line.size - 2):
            left = np.uint8(np.rint(rest * line[x] + most * line[x + 1]))
            right = np.uint8(np.rint(most * line[x + 1] + rest * line[x + 2]))
            fill[4 * x] = left
            fill[4 * x + 1] = left
            fill[4 * x + 2] = right
            fill[4 * x + 3] = right
        blue, green, red = fill, fill[4 * section :], fill[8 * section :]
        for row in (2 * y, 2 * y + 1):
            hidden, pixels = mask[row], picture[row]
            for x in range(4 * width):
                # Bits instead of a choice: so it takes a tenth of the time.
                chosen = np.uint8(255) if hidden[x] else np.uint8(0)
                pixels[3 * x] ^= (pixels[3 * x] ^ blue[x]) & chosen
                pixels[3 * x + 1] ^= (pixels[3 * x + 1] ^ green[x]) & chosen
                pixels[3 * x + 2] ^= (pixels[3 * x + 2] ^ red[x]) & chosen
