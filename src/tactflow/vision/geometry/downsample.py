"""Downsampling by averages over blocks of pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Bytes
from tactflow.vision.compiled import kernel


def halved(picture: Bytes, block: tuple[slice, slice] | None = None) -> Bytes:
    """Means over 2 x 2 pixels of a picture or of a block of it, rounded half up.

    picture : (H, W, 3) uint8. block : rows and columns, slices with start and stop inside the picture; None
    takes all of it. Returns (h // 2, w // 2, 3) uint8; an odd last row or column of the block is left out.

    >>> picture = np.zeros((2, 4, 3), np.uint8)
    >>> picture[0, 0] = 8
    >>> halved(picture)[..., 0]
    array([[2, 0]], dtype=uint8)
    """
    rows, columns = block or (slice(0, picture.shape[0]), slice(0, picture.shape[1]))
    picture = np.ascontiguousarray(picture)
    half = np.empty(((rows.stop - rows.start) // 2, (columns.stop - columns.start) // 2, 3), np.uint8)
    halve(picture.reshape(len(picture), -1), rows.start, 3 * columns.start, half.reshape(len(half), -1))
    return half


def cell_means(picture: NDArray[Any], side: int) -> NDArray[Any]:
    """Means over square cells; means of whole numbers are rounded.

    picture : (H, W) or (H, W, channels), uint8 or float32. side : of a cell, px, a power of two. Returns
    (H // side, W // side, ...) of the picture's dtype. Rows and columns that fill no whole cell are left out;
    a picture smaller than a cell is one cell.

    >>> cell_means(np.arange(10, dtype=np.float32).reshape(2, 5), 2)
    array([[3., 5.]], dtype=float32)
    """
    height, width = (max(extent // side, 1) for extent in picture.shape[:2])
    cells: Any = picture[: height * side, : width * side]
    # OpenCV has a loop of its own for halves: two take a third of the time of one step.
    while side > 1:
        side //= 2
        size = (width * side, height * side)
        cells = cv2.resize(cells, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cells)


@kernel
def halve(picture: Bytes, top: int, left: int, half: Bytes) -> None:
    """Fill `half`, (h, 3 w), from `picture`, (H, 3 W), from row `top` and byte `left` on.

    `cv2.resize` by `INTER_AREA` gives the same, in twice the time.
    """
    rows, columns = slice(top, top + 2 * len(half)), slice(left, left + 2 * half.shape[1])
    window = np.ascontiguousarray(picture[rows, columns]).reshape(2 * len(half), -1, 3)
    means = cv2.resize(window, (half.shape[1] // 3, len(half)), interpolation=cv2.INTER_AREA)
    half[:] = means.reshape(half.shape)
