"""Between a frame's pixels and those of a contact's window, which are as large or twice as large."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask


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
    each = 4 // side
    inside = inside.repeat(each, axis=0).repeat(each, axis=1)
    seen = (mask[top:, left:][: side * inside.shape[0], : side * inside.shape[1]] != 0).view(np.uint8)
    if side == 2:
        seen = np.pad(seen, [(0, length % 2) for length in seen.shape])
        seen = seen[::2, ::2] | seen[::2, 1::2] | seen[1::2, ::2] | seen[1::2, 1::2]
    window = np.zeros(inside.shape, np.uint8)
    window[: seen.shape[0], : seen.shape[1]] = seen
    return window & inside


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
        level = cv2.resize(level, None, fx=2, fy=2)
    part = mask[top:, left:][: level.shape[0], : level.shape[1]]
    positive = level[: part.shape[0], : part.shape[1]] > 0
    part[positive] = 255
    return bool(positive.any())
