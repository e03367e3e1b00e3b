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
    high, wide = 4 // side * inside.shape[0], 4 // side * inside.shape[1]
    seen = np.zeros((side * high, side * wide), np.uint8)
    part = mask[top:, left:][: side * high, : side * wide]
    seen[: part.shape[0], : part.shape[1]] = part
    if side == 2:
        seen = seen[::2] | seen[1::2]
        seen = seen[:, ::2] | seen[:, 1::2]
    cells = cv2.resize(inside.view(np.uint8), (wide, high), interpolation=cv2.INTER_NEAREST)
    return np.asarray(np.minimum(seen, cells), np.uint8)


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
        level = np.asarray(cv2.resize(level, None, fx=2, fy=2), np.float32)
    part = mask[top:, left:][: level.shape[0], : level.shape[1]]
    positive = (level[: part.shape[0], : part.shape[1]] > 0).view(np.uint8)
    np.maximum(part, positive * np.uint8(255), out=part)
    return cv2.countNonZero(positive) > 0
