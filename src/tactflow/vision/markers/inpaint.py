"""Removal of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

import math
import threading
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel
from tactflow.vision.geometry.downsample import halve_block

Bytes = NDArray[np.uint8]
Float = NDArray[np.float32]
Places = NDArray[np.int64]
InpaintMethod = Literal["telea", "ns", "normalized", "none"]

RADIUS: Final = 7.0
"""Neighbourhood from which a marker is filled unless said otherwise, px: that of the original script."""

CELL: Final = 4
"""Side of the blocks on which means are formed, px; the kernels spell it out."""

FAR_WEIGHT: Final = 0.01
"""Weight of the wide window against the 3 x 3 cells around: those decide wherever any of them is valid.
Chosen by hand."""

FRAME_WEIGHT: Final = np.float32(1e-6)
"""Weight of the mean of the whole frame: it decides where a window has no valid pixel. Chosen by hand."""

LEAST_WEIGHT: Final = 1e-3
"""Weight, of at most 255, below which a window has no valid pixel: one px in 10 000 gives more (derived)."""


def remove_markers(
    image: Bytes,
    mask: Bytes,
    *,
    method: InpaintMethod = "normalized",
    radius: float = RADIUS,
) -> Bytes:
    """Replace masked pixels by what surrounds them.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    mask : (H, W) uint8, non-zero where the image is to be replaced.
    method : `normalized` takes a smooth average of the valid pixels around, in about 0.1 ms; `telea` marches
        inwards from the border of the mask, 10 ms and more; `ns` continues lines of equal brightness, as
        slow; `none` returns a copy of the image.
    radius : neighbourhood, px, > 0. For `normalized` about the radius of a dot: a larger one is smoother, a
        much smaller one leaves the middle of a dot to its far surroundings.

    Returns
    -------
    unmarked : (H, W, 3) uint8, a new array; equal to `image` wherever `mask` is 0.

    Raises
    ------
    ValueError : image and mask do not fit together, or the radius is not positive.

    References
    ----------
    A. Telea, "An image inpainting technique based on the fast marching method", 2004.
    M. Bertalmio et al., "Navier-Stokes, fluid dynamics, and image and video inpainting", CVPR 2001.
    H. Knutsson, C.-F. Westin, "Normalized and differential convolution", CVPR 1993.

    Examples
    --------
    >>> gel = np.full((40, 40, 3), 120, np.uint8)
    >>> mask = np.zeros((40, 40), np.uint8)
    >>> mask[15:20, 15:20] = 255
    >>> gel[mask > 0] = 10
    >>> bool((remove_markers(gel, mask) == 120).all())
    True
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"required a non-empty (H, W, 3) uint8 image, got shape {image.shape}, dtype {image.dtype}"
        )
    if mask.shape != image.shape[:2] or mask.dtype != np.uint8:
        raise ValueError(
            f"required a uint8 mask of shape {image.shape[:2]}, got shape {mask.shape}, dtype {mask.dtype}"
        )
    if not (radius > 0 and math.isfinite(radius)):
        raise ValueError(f"radius: required > 0 px, got {radius}")
    if method == "normalized":
        return _normalized(image, mask, radius)
    if method == "none" or not mask.any():
        return image.copy()
    flag = cv2.INPAINT_TELEA if method == "telea" else cv2.INPAINT_NS
    return np.asarray(
        cv2.inpaint(np.ascontiguousarray(image), np.ascontiguousarray(mask), radius, flag), np.uint8
    )


def _normalized(image: Bytes, mask: Bytes, radius: float) -> Bytes:
    """Normalized convolution on means over cells: the sum of the valid ones over their weight.

    Computed in float32; gives what float64 would, to 1 grey level.
    """
    height, width = mask.shape
    bottom, right = -height % CELL, -width % CELL
    hidden = np.ascontiguousarray(mask)
    if not (bottom or right):
        return _fill_cells(image.copy(), hidden, radius)
    frame = (0, bottom, 0, right, cv2.BORDER_REPLICATE)
    whole = np.asarray(cv2.copyMakeBorder(image, *frame), np.uint8)
    hidden = np.asarray(cv2.copyMakeBorder(hidden, *frame), np.uint8)
    return np.ascontiguousarray(_fill_cells(whole, hidden, radius)[:height, :width])


class _Buffers:
    """What `_fill_cells` computes in; see the kernels."""

    def __init__(self, height: int, width: int, reach: int) -> None:
        wide = width + 2 * reach
        self.masked = np.empty(height, np.int64)
        self.either = np.empty(8 * height * width, np.uint8)
        self.valid = np.empty(4 * height * width, np.uint8)
        self.half = np.empty((2 * height, 6 * width), np.uint8)
        self.cells = np.zeros((height + 2 * reach, 4 * wide), np.float32)
        self.rows = np.pad(np.arange(height), reach, mode="reflect") + reach
        self.columns = np.pad(np.arange(width), reach, mode="reflect") + reach
        self.lines = np.empty((3, 4 * wide), np.float32)
        self.sums = np.zeros((height, 4 * wide), np.float32)
        # Whole vectors: what is left of one is computed value by value, slowly.
        vectors = -(-3 * wide // 64)
        self.line = np.zeros(64 * vectors + 2, np.float32)
        self.fill = np.empty(4 * 64 * vectors, np.uint8)


_kept = threading.local()
"""The buffers of each thread, for frames and windows of one size."""


def _fill_cells(whole: Bytes, mask: Bytes, radius: float) -> Bytes:
    """`_normalized` for a picture of whole cells, which is written over and returned.

    The kernels compute with sums where the definition has means, so their weights are up to 64 * 255.
    """
    reach = math.ceil(radius / CELL + 1)
    height, width = mask.shape[0] // CELL, mask.shape[1] // CELL
    kind = (height, width, reach)
    if getattr(_kept, "kind", None) != kind:
        _kept.kind, _kept.buffers = kind, _Buffers(*kind)
    own: _Buffers = _kept.buffers
    section = width + 2 * reach
    picture = whole.reshape(len(whole), -1)
    halve_block(picture, 0, 0, own.half, 0, 0, 2 * height, 2 * width, False, False)
    sum_valid(mask, own.either, own.valid, own.half, own.cells, reach, own.masked)
    far = FAR_WEIGHT * 16 / (2 * reach + 1) ** 2
    least = 64 * LEAST_WEIGHT
    few = sum_windows(own.cells, reach, own.rows, own.columns, far, least, own.lines, own.sums)
    if few:
        inner = own.cells.reshape(-1, 4, section)[reach : reach + height, :, reach : reach + width]
        everywhere = inner.mean(axis=(0, 2), dtype=np.float64).astype(np.float32)
        if everywhere[3] == 0:
            return whole
        own.sums.reshape(height, 4, section)[:] += 16 * FRAME_WEIGHT * everywhere[:, None]
    fill_masked(mask, own.masked, own.sums, section, own.line, own.fill, picture)
    return whole


# A line of cells has four sections one after another, the sums of the three channels and the weight, each
# with a margin of `reach` cells on either side. So one loop serves all of them, and what it computes across
# two sections lies in their margins.

_READ: Final = "Array(uint8, 2, 'C', readonly=True)"
"""numba's type of a picture that a caller may have locked."""


@kernel(f"void({_READ}, uint8[::1], uint8[::1], uint8[:, ::1], float32[:, ::1], int64, int64[::1])")
def sum_valid(
    mask: Bytes, either: Bytes, valid: Bytes, half: Bytes, cells: Float, reach: int, masked: Places
) -> None:
    """Sums over the valid ones of each cell's 2 x 2 values at half resolution, and 255 for each as weight.

    mask : (4 h, 4 w). either : (8 h w,) is written over. valid : (4 h w,) becomes 255 where none of 2 x 2 px
    is masked, else 0. half : (2 h, 6 w), the picture; becomes 0 where not valid. cells : (h + 2 reach,
    4 (w + 2 reach)) is filled but for its margins. masked : (h,) becomes how many cells of each line have a
    masked px.
    """
    wide = mask.shape[1]
    for y in range(half.shape[0]):
        upper, lower, line = mask[2 * y], mask[2 * y + 1], either[y * wide :]
        for x in range(wide):
            line[x] = upper[x] | lower[x]
    for at in range(valid.size):
        valid[at] = 0 if either[2 * at] | either[2 * at + 1] else 255
    values = half.reshape(-1)
    for at in range(valid.size):
        values[3 * at] &= valid[at]
        values[3 * at + 1] &= valid[at]
        values[3 * at + 2] &= valid[at]
    height, width = half.shape[0] // 2, wide // 4
    section, full = width + 2 * reach, np.float32(4 * 255)
    for y in range(height):
        upper, lower, line = half[2 * y], half[2 * y + 1], cells[reach + y]
        first, second, third = line[reach:], line[section + reach :], line[2 * section + reach :]
        for x in range(width):
            first[x] = upper[6 * x] + upper[6 * x + 3] + lower[6 * x] + lower[6 * x + 3]
            second[x] = upper[6 * x + 1] + upper[6 * x + 4] + lower[6 * x + 1] + lower[6 * x + 4]
            third[x] = upper[6 * x + 2] + upper[6 * x + 5] + lower[6 * x + 2] + lower[6 * x + 5]
        above, below = valid[4 * y * width :], valid[(4 * y + 2) * width :]
        weight = line[3 * section + reach :]
        for x in range(width):
            weight[x] = above[2 * x] + above[2 * x + 1] + below[2 * x] + below[2 * x + 1]
        count = 0
        for x in range(width):
            count += weight[x] < full
        masked[y] = count


@helper
def mirror_margins(cells: Float, reach: int, rows: Places, columns: Places) -> None:
    """Fill the margins of `cells` with the cells of which they are the mirror image."""
    section = columns.size
    width, long = section - 2 * reach, 4 * section
    for y in range(cells.shape[0] - 2 * reach):
        line = cells[reach + y]
        for start in range(0, long, section):
            part = line[start:]
            for x in range(reach):
                part[x] = part[columns[x]]
                part[reach + width + x] = part[columns[reach + width + x]]
    for y in range(cells.shape[0]):
        if rows[y] != y:
            line, source = cells[y], cells[rows[y]]
            for x in range(long):
                line[x] = source[x]


@kernel(
    "int64(float32[:, ::1], int64, int64[::1], int64[::1], float32, float32, "
    "float32[:, ::1], float32[:, ::1])"
)
def sum_windows(
    cells: Float,
    reach: int,
    rows: Places,
    columns: Places,
    far: float,
    least: float,
    lines: Float,
    sums: Float,
) -> int:
    """Binomial windows of 3 x 3 cells plus `far` times windows of 2 reach + 1 cells each way.

    cells : (h + 2 reach, 4 (w + 2 reach)), of `sum_valid`; its margins are filled. rows : (h + 2 reach,) and
    columns : (w + 2 reach,), the row and column of which each one of `cells` is a copy; itself, if not in a
    margin. lines : (3, 4 (w + 2 reach)) is written over. sums : (h, 4 (w + 2 reach)) is filled; each section
    starts with its first cell, and 2 reach values at its end mean nothing. Returns how many weights are below
    `least`.
    """
    section = columns.size
    height, width, long = sums.shape[0], section - 2 * reach, 4 * section
    mirror_margins(cells, reach, rows, columns)
    # Sums of whole numbers below 2**24 are exact, in whatever order.
    tall, wide, near = lines[0], lines[1], lines[2]
    tall[:] = 0
    for y in range(2 * reach):
        line = cells[y]
        for x in range(long):
            tall[x] += line[x]
    two = np.float32(2)
    few, count = 0, long - 2 * reach
    for y in range(height):
        first, last, out = cells[y], cells[y + 2 * reach], sums[y]
        for x in range(long):
            tall[x] += last[x]
            wide[x] = tall[x]
        for step in range(1, 2 * reach, 2):
            beside = tall[step:]
            for x in range(count):
                wide[x] += beside[x] + beside[x + 1]
        above, here, below = cells[y + reach - 1], cells[y + reach], cells[y + reach + 1]
        for x in range(long):
            near[x] = above[x] + two * here[x] + below[x]
        left, middle, right = near[reach - 1 :], near[reach:], near[reach + 1 :]
        for x in range(count):
            out[x] = left[x] + two * middle[x] + right[x] + far * wide[x]
        weight = out[3 * section :]
        for x in range(width):
            few += weight[x] < least
        for x in range(long):
            tall[x] -= first[x]
    return few


@kernel(f"void({_READ}, int64[::1], float32[:, ::1], int64, float32[::1], uint8[::1], uint8[:, ::1])")
def fill_masked(
    mask: Bytes, masked: Places, sums: Float, section: int, line: Float, fill: Bytes, picture: Bytes
) -> None:
    """Masked px become the sums over their weight, interpolated between the centres of cells.

    mask : (4 h, 4 w). masked : (h,), of `sum_valid`. sums : (h, 4 section), of `sum_windows`; becomes the
    quotients. line : (3 section + 2 or a little more,) and fill : (4 times that,) are written over.
    picture : (4 h, 12 w).
    """
    height, width = sums.shape[0], mask.shape[1] // 4
    for y in range(height):
        weight = sums[y, 3 * section :]
        for x in range(width):
            line[x] = np.float32(255) / weight[x]
        for start in range(0, 3 * section, section):
            part = sums[y, start:]
            for x in range(width):
                part[x] *= line[x]
    most, rest = np.float32(0.75), np.float32(0.25)
    inner = line[1:]
    for y in range(2 * height):
        cell = y // 2
        if masked[cell] == 0:
            continue
        other = max(cell - 1, 0) if y % 2 == 0 else min(cell + 1, height - 1)
        here, beyond = sums[cell], sums[other]
        for x in range(3 * section):
            inner[x] = most * here[x] + rest * beyond[x]
        # Beyond its ends a section goes on as it ends; there is room in the margins.
        for start in range(0, 3 * section, section):
            line[start] = inner[start]
            inner[start + width] = inner[start + width - 1]
        for x in range(line.size - 2):
            left = np.uint8(np.rint(rest * line[x] + most * line[x + 1]))
            right = np.uint8(np.rint(most * line[x + 1] + rest * line[x + 2]))
            fill[4 * x] = left
            fill[4 * x + 1] = left
            fill[4 * x + 2] = right
            fill[4 * x + 3] = right
        blue, green, red = fill, fill[4 * section :], fill[8 * section :]
        for row in (2 * y, 2 * y + 1):
            hidden, pixels = mask[row], picture[row]
            for x in range(4 * width):
                # Bits instead of a choice: so it takes a tenth of the time.
                chosen = np.uint8(255) if hidden[x] else np.uint8(0)
                pixels[3 * x] ^= (pixels[3 * x] ^ blue[x]) & chosen
                pixels[3 * x + 1] ^= (pixels[3 * x + 1] ^ green[x]) & chosen
                pixels[3 * x + 2] ^= (pixels[3 * x + 2] ^ red[x]) & chosen
