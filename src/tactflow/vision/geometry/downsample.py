"""Downsampling by two: block averages of 2 x 2 pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Bytes = NDArray[np.uint8]

_BAND = 4
"""Output lines computed at a time. Derived: their eight input lines fit into the nearest cache (800 px wide:
19 kB of 32 kB)."""


@kernel(
    "void(Array(uint8, 2, 'C', readonly=True), int64, int64, "
    "uint8[:, ::1], int64, int64, int64, int64, boolean, boolean)"
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
    upside_down: bool,
) -> None:
    """Means over 2 x 2 px of a block of a picture, into a block of another; rounded half up, as OpenCV does.

    picture : (H, 3 W) uint8. top, left : first row and column of the block, px.
    half : (h, 3 w) uint8; height x width px from half_top and half_left on are written.
    far : whether the picture is not in the caches, or its memory not even mapped, as in a recording.
    upside_down : whether the block's first line becomes the last one.
    The caller sees to it that both blocks lie inside their pictures.
    """
    stride = picture.shape[1]
    values = picture.reshape(-1)
    for band in range(0, height, _BAND):
        end = min(band + _BAND, height)
        if far:
            # Memory is mapped in half the time if it is read in order once before two lines are read side by
            # side.
            start = (top + 2 * band) * stride + 3 * left
            read = values[start : start + (2 * (end - band) - 1) * stride + 6 * width]
            any_bits = np.uint8(0)
            for x in range(read.size):
                any_bits = np.uint8(any_bits | read[x])
            # The compiler drops a result that goes nowhere; this one is written over below.
            half[half_top + (height - 1 - band if upside_down else band), 3 * half_left] = any_bits
        for y in range(band, end):
            upper, lower = picture[top + 2 * y, 3 * left :], picture[top + 2 * y + 1, 3 * left :]
            line = half[half_top + (height - 1 - y if upside_down else y), 3 * half_left :]
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
    picture: Bytes,
    block: tuple[slice, slice] | None = None,
    *,
    into: Bytes | None = None,
    far: bool = False,
    upside_down: bool = False,
) -> Bytes:
    """Means over 2 x 2 px of a picture or of a block of it, rounded half up.

    picture : (H, W, 3) uint8.
    block : rows and columns, slices with start and stop inside the picture; None takes all of it.
    into : (h // 2, w // 2, 3) uint8, C-contiguous; is written and returned, if given.
    far : whether the picture has not been read before; a matter of speed.
    upside_down : whether the block's first line becomes the last one.
    Returns (h // 2, w // 2, 3) uint8; an odd last row or column of the block is left out.

    >>> picture = np.zeros((2, 4, 3), np.uint8)
    >>> picture[0, 0] = 8
    >>> halved(picture)[..., 0]
    array([[2, 0]], dtype=uint8)
    """
    rows, columns = block or (slice(0, picture.shape[0]), slice(0, picture.shape[1]))
    if not picture.flags.c_contiguous:
        picture = np.ascontiguousarray(picture[rows, columns])
        rows, columns = slice(0, picture.shape[0]), slice(0, picture.shape[1])
    height, width = (rows.stop - rows.start) // 2, (columns.stop - columns.start) // 2
    half = np.empty((height, width, 3), np.uint8) if into is None else into
    lines = half.reshape(height, 3 * width)
    flat = picture.reshape(len(picture), -1)
    halve_block(flat, rows.start, columns.start, lines, 0, 0, height, width, far, upside_down)
    return half
