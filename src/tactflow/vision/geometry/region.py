"""What a mask shows: bounding box, moments and outline of all that is set."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Mask
from tactflow.vision.compiled import kernel


class Region(NamedTuple):
    """The pixels of a mask that are set; lengths in px, sums in whole numbers.

    left, top, width, height : their bounding box; all 0 if there are none.
    pixels : how many. x, y : sums of their coordinates. xx, xy, yy : sums of products of these.
    in_one_piece : True for a region (8-connected) of which each row is one run of pixels; False where it
        takes contours to tell.
    ends : (2 h, 2) int32, x and y of the first and the last pixel of each row of the box that has any.
    """

    left: int
    top: int
    width: int
    height: int
    pixels: int
    x: int
    y: int
    xx: int
    xy: int
    yy: int
    in_one_piece: bool
    ends: NDArray[np.int32]


def measure_region(mask: Mask) -> Region:
    """Measure a mask.

    mask : (H, W) uint8, not 0 inside.

    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:7, 5:8] = 255
    >>> region = measure_region(mask)
    >>> region.width, region.height, region.pixels, region.in_one_piece
    (3, 2, 6, True)
    """
    ends, found = np.empty((2 * len(mask), 2), np.int32), np.zeros(12, np.int64)
    _measure(np.ascontiguousarray(mask), ends, found)
    *numbers, in_one_piece, count = found.tolist()
    return Region(*numbers, in_one_piece == 1, ends[:count])  # type: ignore[call-arg, arg-type]


@kernel("void(Array(uint8, 2, 'C', readonly=True), int32[:, ::1], int64[::1])")
def _measure(mask: Mask, ends: NDArray[np.int32], found: NDArray[np.int64]) -> None:
    """Fill `found`, (12,), with the numbers of a `Region`, and how many of the ends are filled."""
    height, width = mask.shape
    left, right, top, bottom, count = width, -1, -1, -1, 0
    in_one_piece = True
    pixels = sum_x = sum_y = sum_xx = sum_xy = sum_yy = np.int64(0)
    for y in range(height):
        row, any_bits = mask[y], np.uint8(0)
        for i in range(width):
            any_bits = np.uint8(any_bits | row[i])
        if not any_bits:
            continue
        first, last, number, ones, twos = 0, width - 1, 0, 0, 0
        while row[first] == 0:
            first += 1
        while row[last] == 0:
            last -= 1
        for i in range(first, last + 1):
            number += 1 if row[i] != 0 else 0
            ones += i if row[i] != 0 else 0
            twos += i * i if row[i] != 0 else 0
        touching = count == 0 or (
            bottom == y - 1 and ends[count - 2, 0] <= last + 1 and first <= ends[count - 1, 0] + 1
        )
        in_one_piece = in_one_piece and touching and number == last + 1 - first
        ends[count, 0], ends[count, 1], ends[count + 1, 0], ends[count + 1, 1] = first, y, last, y
        top, bottom, count = y if count == 0 else top, y, count + 2
        left, right = min(left, first), max(right, last)
        pixels, sum_x, sum_xx = pixels + number, sum_x + ones, sum_xx + twos
        sum_y, sum_xy, sum_yy = sum_y + number * y, sum_xy + ones * y, sum_yy + number * y * y
    if count:
        found[0], found[1], found[2], found[3] = left, top, right + 1 - left, bottom + 1 - top
        found[4], found[5], found[6] = pixels, sum_x, sum_y
        found[7], found[8], found[9] = sum_xx, sum_xy, sum_yy
        found[10], found[11] = 1 if in_one_piece else 0, count
