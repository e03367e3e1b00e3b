"""Pictures at half their size."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.compiled import kernel

Bytes = NDArray[np.uint8]

_BAND = 4
"""Lines computed at a time: what they are computed from, twice as many, fits into the nearest cache."""


@kernel(
    "void(Array(uint8, 2, 'C', readonly=True), int64, int64, "
    "uint8[:, ::1], int64, int64, int64, int64, boolean)"
)
def halve_block(
    picture: Bytes,
    top: int,
    left: int,
    half: Bytes,
    half_top: int,
    half_left: int,
    height: int,
    width: int,
    far: bool,
) -> None:
    """Means over 2 x 2 px of a block of a picture, into a block of another; rounded half up, as OpenCV does.

    picture : (H, 3 W). top, left : first row and column of the block, px. half : (h, 3 w), of which
    height x width px from half_top and half_left on are written. far : whether the picture is not in the
    caches, or its memory not even mapped, as a frame of a recording. The caller sees to it that both blocks
    lie inside their pictures.
    """
    stride = picture.shape[1]
    values = picture.reshape(-1)
    for band in range(0, height, _BAND):
        end = min(band + _BAND, height)
        if far:
            # Mapping memory costs half as much while values are read one after another as it does while two
            # lines are read side by side.
            start = (top + 2 * band) * stride + 3 * left
            read = values[start : start + (2 * (end - band) - 1) * stride + 6 * width]
            any_bits = np.uint8(0)
            for x in range(read.size):
                any_bits = np.uint8(any_bits | read[x])
            # Written over below: a result that goes nowhere would not be computed.
            half[half_top + band, 3 * half_left] = any_bits
        for y in range(band, end):
            upper, lower = picture[top + 2 * y, 3 * left :], picture[top + 2 * y + 1, 3 * left :]
            line = half[half_top + y, 3 * half_left :]
            # The channels one by one: so the compiler turns the line into whole vectors.
            for x in range(width):
                line[3 * x] = (upper[6 * x] + upper[6 * x + 3] + lower[6 * x] + lower[6 * x + 3] + 2) >> 2
                line[3 * x + 1] = (
                    upper[6 * x + 1] + upper[6 * x + 4] + lower[6 * x + 1] + lower[6 * x + 4] + 2
                ) >> 2
                line[3 * x + 2] = (
                    upper[6 * x + 2] + upper[6 * x + 5] + lower[6 * x + 2] + lower[6 * x + 5] + 2
                ) >> 2


def halved(
    picture: Bytes, block: tuple[slice, slice] | None = None, *, into: Bytes | None = None, far: bool = False
) -> Bytes:
    """Means over 2 x 2 px of a picture or of a block of it, rounded half up.

    picture : (H, W, 3) uint8. block : rows and columns, slices with start and stop inside the picture;
    None takes all of it. into : (h // 2, w // 2, 3) uint8, C-contiguous, is written and returned, if given.
    far : whether the picture has not been read before; a matter of speed.
    Returns (h // 2, w // 2, 3) uint8; an odd last row or column of the block is left out.
    """
    rows, columns = block or (slice(0, picture.shape[0]), slice(0, picture.shape[1]))
    height, width = (rows.stop - rows.start) // 2, (columns.stop - columns.start) // 2
    if compiled.active() and picture.flags.c_contiguous:
        half = np.empty((height, width, 3), np.uint8) if into is None else into
        lines = half.reshape(height, 3 * width)
        flat = picture.reshape(len(picture), -1)
        halve_block(flat, rows.start, columns.start, lines, 0, 0, height, width, far)
        return half
    even = picture[rows.start : rows.start + 2 * height, columns.start : columns.start + 2 * width]
    return np.asarray(cv2.resize(even, (width, height), dst=into, interpolation=cv2.INTER_AREA), np.uint8)
