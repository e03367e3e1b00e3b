"""Compiled loops of `marker_mask`: what they compute is written with OpenCV there.

They run over pictures as one long line. Shifted by a fixed number of bytes, such a line is what each pixel
has beside it in some direction; so every loop is one over whole vectors of bytes. What wraps from the end of
a row to the start of the next lies in a margin around the picture, which is 255 and never a spot.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Bytes = NDArray[np.uint8]


@kernel("void(uint8[:, ::1], int64, int64[::1], uint8[::1])")
def contrast_with_circle(picture: Bytes, reach: int, steps: NDArray[np.int64], contrast: Bytes) -> None:
    """How much darker each value is than the least of twelve places around it; 0 where it is not.

    picture : (h + 2 reach, 3 (w + 2 reach)), with a margin of 255. steps : (12,), from a value to the twelve
    of its circle, in bytes; none leads out of a frame of `reach` px. contrast : as long as the picture;
    its first and last `reach` rows and px are left as they are.
    """
    values = picture.reshape(-1)
    start = reach * (picture.shape[1] + 3)
    count = values.size - 2 * start
    here, out = values[start : start + count], contrast[start : start + count]
    # One name for each of the twelve: a loop over them would go through memory for every one.
    a, b = values[start + steps[0] :][:count], values[start + steps[1] :][:count]
    c, d = values[start + steps[2] :][:count], values[start + steps[3] :][:count]
    e, f = values[start + steps[4] :][:count], values[start + steps[5] :][:count]
    g, h = values[start + steps[6] :][:count], values[start + steps[7] :][:count]
    i, j = values[start + steps[8] :][:count], values[start + steps[9] :][:count]
    k, m = values[start + steps[10] :][:count], values[start + steps[11] :][:count]
    for at in range(count):
        least = min(min(min(a[at], b[at]), min(c[at], d[at])), min(min(e[at], f[at]), min(g[at], h[at])))
        least = min(least, min(min(i[at], j[at]), min(k[at], m[at])))
        out[at] = max(least, here[at]) - here[at]


@kernel("void(uint8[::1], int64, int64, int64, uint8[:, ::1], uint8[::1], uint8[:, ::1])")
def cover_spots(
    contrast: Bytes, limit: int, reach: int, corner: int, spots: Bytes, doubled: Bytes, mask: Bytes
) -> None:
    """255 on and next to every px whose median contrast exceeds a limit, at twice the size.

    contrast : of `contrast_with_circle`. limit : grey levels, 0 to 255. corner : px; squares of that side in
    the picture's corners hold no spot. spots : (h + 2 reach, w + 2 reach), reach >= 1, and doubled, of twice
    its length, are written over. mask : (2 h, 2 w) is filled.
    """
    wide, flat = spots.shape[1], spots.reshape(-1)
    least = np.uint8(limit)
    for at in range(flat.size):
        first, second, third = contrast[3 * at], contrast[3 * at + 1], contrast[3 * at + 2]
        median = max(min(first, second), min(max(first, second), third))
        flat[at] = 255 if median > least else 0
    height, width = mask.shape[0] // 2, mask.shape[1] // 2
    side = min(corner, width)
    for y in range(min(corner, height)):
        for row in (reach + y, reach + height - 1 - y):
            spots[row, reach : reach + side] = 0
            spots[row, reach + width - side : reach + width] = 0
    start = reach * wide
    count = flat.size - 2 * start
    above, here, below = flat[start - wide - 1 :], flat[start - 1 :], flat[start + wide - 1 :]
    for x in range(count):
        near = above[x] | here[x] | below[x]
        near |= above[x + 1] | here[x + 1] | below[x + 1]
        near |= above[x + 2] | here[x + 2] | below[x + 2]
        doubled[2 * x] = near
        doubled[2 * x + 1] = near
    # Copied value by value, which becomes whole vectors; a slice assigned to a slice does not.
    for y in range(height):
        line, upper, lower = doubled[2 * (y * wide + reach) :], mask[2 * y], mask[2 * y + 1]
        for x in range(2 * width):
            upper[x] = line[x]
            lower[x] = line[x]
