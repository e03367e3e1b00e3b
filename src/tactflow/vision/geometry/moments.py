"""Compiled loop of `hull`: what it computes is done with OpenCV there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Whole = NDArray[np.int64]


@kernel("void(uint8[:, ::1], int64[::1])")
def measure_region(mask: NDArray[np.uint8], found: Whole) -> None:
    """Set `found`: left, top, width and height of the bounding box of the non-zero pixels; their number; the
    sums of x, y, x^2, x y and y^2 over them, relative to the corner of the box. All 0 where there are none.
    """
    height, width = mask.shape
    # Additions of what is there are done many at once, multiplications are not.
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
        for x in range(width):
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
