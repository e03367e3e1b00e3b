"""Moments of a region: its bounding box and the sums that centre, area and direction follow from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Whole = NDArray[np.int64]


class Box(NamedTuple):
    """A bounding box, px: its first column and row, its width and height; all 0 for an empty region."""

    left: int
    top: int
    width: int
    height: int


class Moments(NamedTuple):
    """Sums over the pixels of a region, relative to some pixel; whole numbers, so exact.

    pixels : how many. x, y : sums of the coordinates, px. xx, xy, yy : sums of their products, px^2.
    """

    pixels: int
    x: int
    y: int
    xx: int
    xy: int
    yy: int

    def central(self) -> tuple[int, int, int]:
        """Second central moments xx, xy, yy times the number of pixels; exact."""
        count, x, y, xx, xy, yy = self
        return count * xx - x * x, count * xy - x * y, count * yy - y * y

    def moved(self, right: int, down: int) -> Moments:
        """The same region with its coordinates increased by (right, down) px."""
        count, x, y, xx, xy, yy = self
        return Moments(
            count,
            x + right * count,
            y + down * count,
            xx + 2 * right * x + right * right * count,
            xy + right * y + down * x + right * down * count,
            yy + 2 * down * y + down * down * count,
        )


def region_moments(mask: NDArray[np.uint8]) -> tuple[Box, Moments]:
    """Bounding box of the non-zero pixels, and their moments relative to its corner.

    mask : (H, W) uint8, H and W >= 1.

    >>> mask = np.zeros((5, 8), np.uint8)
    >>> mask[2, 3:6] = 255
    >>> region_moments(mask)
    (Box(left=3, top=2, width=3, height=1), Moments(pixels=3, x=3, y=0, xx=5, xy=0, yy=0))
    """
    found = np.empty(10, np.int64)
    measure_region(np.ascontiguousarray(mask), found)
    numbers = found.tolist()
    return Box(*numbers[:4]), Moments(*numbers[4:])


@kernel("void(uint8[:, ::1], int64[::1])")
def measure_region(mask: NDArray[np.uint8], found: Whole) -> None:
    """Set `found` as `region_moments` returns it, in one row. All 0 where no pixel is set.

    mask : (H, W) uint8. found : (10,) int64.
    """
    height, width = mask.shape
    # Squares from a table: the compiler adds many numbers at once, but multiplies one by one.
    squares = np.empty(width, np.int64)
    columns = np.zeros(width, np.uint8)
    for x in range(width):
        squares[x] = x * x
    top = bottom = -1
    count = sx = sy = sxx = sxy = syy = np.int64(0)
    for y in range(height):
        row = mask[y]
        some = np.uint8(0)
        for x in range(width):
            some = np.uint8(some | row[x])
        if some == 0:
            continue
        top, bottom = y if top < 0 else top, y
        number = first = second = np.int64(0)
        for x in range(width):
            columns[x] |= row[x]
            number += 1 if row[x] != 0 else 0
            first += x if row[x] != 0 else 0
            second += squares[x] if row[x] != 0 else 0
        count, sx, sxx = count + number, sx + first, sxx + second
        sy, sxy, syy = sy + number * y, sxy + first * y, syy + number * y * y
    found[:] = 0
    if count == 0:
        return
    left, right = 0, width - 1
    while columns[left] == 0:
        left += 1
    while columns[right] == 0:
        right -= 1
    found[0], found[1], found[2], found[3] = left, top, right + 1 - left, bottom + 1 - top
    found[4], found[5], found[6] = count, sx - left * count, sy - top * count
    found[7] = sxx - 2 * left * sx + left * left * count
    found[8] = sxy - left * sy - top * sx + left * top * count
    found[9] = syy - 2 * top * sy + top * top * count
