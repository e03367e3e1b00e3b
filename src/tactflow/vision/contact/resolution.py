"""Between a frame's pixels and those of a contact's window, which are as large or twice as large."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.compiled import kernel


def window_mask(mask: Mask, top: int, left: int, inside: NDArray[np.bool_], side: int = 2) -> Mask:
    """A window of a mask: 1 where any px below a pixel is not 0 and counts, else 0.

    mask : (H, W) uint8, over whose border the window may reach. top, left : of the window, px. inside :
    (h, w) bool, which cells of 4 x 4 px count. side : of the window's pixels, px, 1 or 2. Returns
    (4 h / side, 4 w / side) uint8.

    >>> import numpy as np
    >>> mask = np.zeros((8, 8), np.uint8)
    >>> mask[5, 2] = 255
    >>> window_mask(mask, 4, 0, np.ones((1, 1), np.bool_))
    array([[0, 1],
           [0, 0]], dtype=uint8)
    """
    if side == 1:
        inside = inside.repeat(4, axis=0).repeat(4, axis=1)
        seen = mask[top:, left:][: inside.shape[0], : inside.shape[1]]
        window = np.zeros(inside.shape, np.uint8)
        window[: seen.shape[0], : seen.shape[1]] = seen != 0
        return window & inside
    halved = np.empty((2 * inside.shape[0], 2 * inside.shape[1]), np.uint8)
    halve_window(np.ascontiguousarray(mask), top, left, inside.view(np.uint8), halved)
    return halved


def draw_level(level: Floats32, top: int, left: int, mask: Mask, side: int = 2) -> bool:
    """Set to 255 the pixels of a mask where a level set, interpolated to their resolution, is positive.

    Returns whether there are any.

    level : (h, w) float32. top, left : its place in the mask, px, over whose border it may reach. mask :
    (H, W) uint8, changed in place. side : of the level's pixels, px, 1 or 2.

    >>> import numpy as np
    >>> mask = np.zeros((2, 4), np.uint8)
    >>> draw_level(np.array([[1, -1]], np.float32), 0, 0, mask)
    True
    >>> mask
    array([[255, 255,   0,   0],
           [255, 255,   0,   0]], dtype=uint8)
    """
    if side == 2:
        return raise_mask(level, top, left, mask)
    part = mask[top:, left:][: level.shape[0], : level.shape[1]]
    positive = level[: part.shape[0], : part.shape[1]] > 0
    part[positive] = 255
    return bool(positive.any())


@kernel("boolean(float32[:, ::1], int64, int64, uint8[:, ::1])")
def raise_mask(level: Floats32, top: int, left: int, mask: Mask) -> bool:
    """What `draw_level` does from half resolution."""
    high, wide = level.shape
    near, far = np.float32(0.75), np.float32(0.25)
    # With a pixel more on both sides, as its neighbour.
    mixed, line, any_bits = np.empty(wide + 2, np.float32), np.empty(2 * wide, np.uint8), np.uint8(0)
    for y in range(min(2 * high, mask.shape[0] - top)):
        here, other = level[y // 2], level[min(max(y // 2 + 2 * (y & 1) - 1, 0), high - 1)]
        for x in range(wide):
            mixed[x + 1] = here[x] * near + other[x] * far
        mixed[0], mixed[wide + 1] = mixed[1], mixed[wide]
        for x in range(wide):
            line[2 * x] = np.uint8(255 if mixed[x + 1] * near + mixed[x] * far > 0 else 0)
            line[2 * x + 1] = np.uint8(255 if mixed[x + 1] * near + mixed[x + 2] * far > 0 else 0)
        row = mask[top + y, left:]
        for x in range(min(2 * wide, row.size)):
            row[x] |= line[x]
            any_bits = np.uint8(any_bits | line[x])
    return bool(any_bits)


@kernel("void(Array(uint8, 2, 'C', readonly=True), int64, int64, uint8[:, ::1], uint8[:, ::1])")
def halve_window(mask: Mask, top: int, left: int, inside: Mask, halved: Mask) -> None:
    """What `window_mask` does at half resolution; `halved`, (2 h, 2 w), is filled."""
    (rows, columns), (high, wide) = mask.shape, halved.shape
    high, wide = min(high, (rows - top + 1) // 2), min(wide, (columns - left + 1) // 2)
    halved[:] = 0
    any_of = np.empty(wide, np.uint8)
    for y in range(high):
        first, row = top + 2 * y, halved[y]
        upper, lower = mask[first, left:], mask[min(first + 1, rows - 1), left:]
        whole = min(wide, upper.size // 2)
        for x in range(whole):
            any_of[x] = upper[2 * x] | upper[2 * x + 1] | lower[2 * x] | lower[2 * x + 1]
        for x in range(whole, wide):
            any_of[x] = upper[2 * x] | lower[2 * x]
        cells = inside[y // 2]
        for x in range(wide // 2):
            row[2 * x] = np.uint8((any_of[2 * x] != 0) & (cells[x] != 0))
            row[2 * x + 1] = np.uint8((any_of[2 * x + 1] != 0) & (cells[x] != 0))
        if wide % 2:
            row[wide - 1] = np.uint8((any_of[wide - 1] != 0) & (cells[wide // 2] != 0))
