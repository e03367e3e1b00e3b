"""Downsampling by two: block averages of 2 x 2 pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel, prefetch

Bytes = NDArray[np.uint8]

_STEP = 320
"""Bytes of a line computed at a time where what comes next is asked for. Measured: 192 is as good, 96 and 640
take a twentieth to a tenth more time."""
_CACHE_LINE = 64
"""Bytes that memory gives at a time, on most processors."""
_AHEAD = 2
"""Lines of the picture from those that are read to those that are asked for. Measured: 1 and 4 are as good, 8
are not."""


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
    far : whether the picture is not in the caches. Then what comes next is asked for ahead of its use, which
        takes a bit more than half of the time.
    upside_down : whether the block's first line becomes the last one.
    The caller sees to it that both blocks lie inside their pictures.
    """
    stride = picture.shape[1]
    values = picture.reshape(-1)
    # The means around every px of a line; every other one is kept. Both loops become whole vectors: half to
    # two thirds of the time of computing only those that are kept.
    means = np.empty(6 * width, np.uint8)
    count = 6 * width - 3
    step = _STEP if far else max(count, 1)
    # Bytes that a step asks for, of two whole lines: memory is faster in its own order, without gaps.
    share = 2 * stride * step // max(6 * width, 1)
    for y in range(height):
        start = (top + 2 * y) * stride + 3 * left
        ahead = start + _AHEAD * stride
        for first in range(0, count, step):
            if far:
                for place in range(ahead, ahead + share, _CACHE_LINE):
                    prefetch(values, place)
                ahead += share
            upper, part = values[start + first :], means[first:]
            lower = upper[stride:]
            for i in range(min(step, count - first)):
                part[i] = (upper[i] + upper[i + 3] + lower[i] + lower[i + 3] + 2) >> 2
        line = half[half_top + (height - 1 - y if upside_down else y), 3 * half_left :]
        for x in range(width):
            for c in range(3):
                line[3 * x + c] = means[6 * x + c]


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
    far : whether the picture is not in the caches; a matter of speed.
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
