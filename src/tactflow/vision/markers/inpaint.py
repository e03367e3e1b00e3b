"""Inpainting of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats32, Indices, check_color_image
from tactflow.vision.compiled import kernel
from tactflow.vision.geometry.downsample import halved

Bytes = NDArray[np.uint8]
Sums = NDArray[np.uint16]
InpaintMethod = Literal["telea", "ns", "normalized", "none"]
_METHODS: Final = get_args(InpaintMethod)

RADIUS_PX: Final = 7.0
"""Default neighbourhood from which a marker is filled, px: that of the original script."""

CELL_PX: Final = 4
"""Side of the cells over which means are formed, px; hard-coded in the kernels."""

FAR_WEIGHT: Final = 0.01
"""Weight of the wide window relative to the 3 x 3 cells around, which decide wherever one of them is valid.
Chosen by hand."""

FRAME_WEIGHT: Final = np.float32(1e-6)
"""Weight of the mean of the whole frame, which decides where a window has no valid pixel. Chosen by hand."""

MIN_WEIGHT: Final = 1e-3
"""Weight, of at most 255, below which a window has no valid pixel: one px in 10 000 gives more (derived)."""

MAX_REACH_CELLS: Final = 31
"""Maximum half-width of the wide window, cells, so that sums of its columns fit in 16 bits. Derived: 63 cells
of at most 4 * 255 are below 2**16."""

LANES: Final = 32
"""The sections of a line are padded to multiples of this number of cells, whole vector registers; remainders
would be computed value by value."""


def remove_markers(
    image: Bytes,
    mask: Bytes,
    *,
    method: InpaintMethod = "normalized",
    radius: float = RADIUS_PX,
) -> Bytes:
    """Replace masked pixels by what surrounds them.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    mask : (H, W) uint8, non-zero where the image is to be replaced.
    method : `normalized` takes a smooth average of the valid pixels around, in about 0.1 ms; `telea` marches
        inwards from the border of the mask, 10 ms and more; `ns` continues lines of equal brightness, as
        slow; `none` returns a copy of the image.
    radius : neighbourhood, px, > 0. For `normalized` about the radius of a dot: a larger one is smoother,
    with
        a much smaller one the middle of a dot is filled from far away; beyond 120 px it has no further
        effect.

    Returns
    -------
    unmarked : (H, W, 3) uint8, a new array; equal to `image` wherever `mask` is 0.

    Raises
    ------
    ValueError : image and mask differ in size, the method is unknown, or the radius is not positive.

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
    _check(image, mask, method, radius)
    if method == "normalized":
        return _normalized(image, mask, radius)
    if method == "none" or not mask.any():
        return image.copy()
    flag = cv2.INPAINT_TELEA if method == "telea" else cv2.INPAINT_NS
    return np.asarray(
        cv2.inpaint(np.ascontiguousarray(image), np.ascontiguousarray(mask), radius, flag), np.uint8
    )


def _check(image: Bytes, mask: Bytes, method: str, radius: float) -> None:
    """Validate the arguments of `remove_markers`."""
    check_color_image(image)
    if mask.shape != image.shape[:2] or mask.dtype != np.uint8:
        raise ValueError(
            f"required a uint8 mask of shape {image.shape[:2]}, got shape {mask.shape}, dtype {mask.dtype}"
        )
    if method not in _METHODS:
        raise ValueError(f"method: required one of {_METHODS}, got {method!r}")
    if not (radius > 0 and math.isfinite(radius)):
        raise ValueError(f"radius: required > 0 px, got {radius}")


def _normalized(image: Bytes, mask: Bytes, radius: float) -> Bytes:
    """Normalized convolution on means over cells: the sum of the valid ones over their weight.

    Computed in float32, within 1 grey level of the result in float64.
    """
    height, width = mask.shape
    bottom, right = -height % CELL_PX, -width % CELL_PX
    hidden = np.ascontiguousarray(mask)
    if not (bottom or right):
        return _fill_cells(image.copy(), hidden, radius)
    frame = (0, bottom, 0, right, cv2.BORDER_REPLICATE)
    whole = np.asarray(cv2.copyMakeBorder(image, *frame), np.uint8)
    hidden = np.asarray(cv2.copyMakeBorder(hidden, *frame), np.uint8)
    return np.ascontiguousarray(_fill_cells(whole, hidden, radius)[:height, :width])


def _fill_cells(whole: Bytes, mask: Bytes, radius: float) -> Bytes:
    """`_normalized` for a picture of whole cells, which is overwritten and returned.

    The kernels use sums instead of means, so weights are up to 64 * 255.
    """
    reach = min(math.ceil(radius / CELL_PX + 1), MAX_REACH_CELLS)
    height, width = mask.shape[0] // CELL_PX, mask.shape[1] // CELL_PX
    rows, columns = _reflected(height, reach + 1), _reflected(width, reach) + reach
    long = 4 * (-(-(width + 2 * reach) // LANES) * LANES)
    cells, masked = np.zeros((height, long), np.uint16), np.empty(height, np.bool_)
    sum_valid(mask, halved(whole).reshape(2 * height, -1), columns, cells, masked)
    far = FAR_WEIGHT * 16 / (2 * reach + 1) ** 2
    windows = np.zeros((height, long), np.float32)
    if sum_windows(cells, masked, rows, reach, width, far, 64 * MIN_WEIGHT, windows):
        inner = cells.reshape(height, 4, -1)[:, :, reach : reach + width]
        everywhere = inner.mean(axis=(0, 2), dtype=np.float64).astype(np.float32)
        if everywhere[3] == 0:
            return whole
        windows.reshape(height, 4, -1)[:] += 16 * FRAME_WEIGHT * everywhere[:, None]
    fill_masked(mask, masked, windows, whole.reshape(len(whole), -1))
    return whole


@lru_cache(maxsize=32)
def _reflected(count: int, margin: int) -> Indices:
    """Indices of the cells of a line, extended by reflection by `margin` cells on either side."""
    return np.pad(np.arange(count), margin, mode="reflect")


# A line of cells has four consecutive sections: the sums of the three channels, and the weight. Each has a
# margin of at least `reach` cells on either side, so that one loop can run over all sections: results across
# two of them fall into the margins. Loops never write to the array that they read, so that the compiler can
# vectorise them.

_READ: Final = "Array(uint8, 2, 'C', readonly=True)"
"""numba's type of a picture that may be read-only."""


@kernel(f"void({_READ}, uint8[:, ::1], int64[::1], uint16[:, ::1], boolean[::1])")
def sum_valid(mask: Bytes, half: Bytes, columns: Indices, cells: Sums, masked: Flags) -> None:
    """Sums over the valid ones of each cell's 2 x 2 values at half resolution, and 255 for each as weight.

    A value is valid where none of its 2 x 2 px is masked. mask : (4 h, 4 w). half : (2 h, 6 w), the picture.
    columns : (w + 2 reach,), for each place in a section, the place whose cell it repeats. cells :
    (h, 4 sections) and masked : (h,), whether a line has a masked px, are filled.
    """
    width, wide, section = mask.shape[1] // 4, half.shape[1], cells.shape[1] // 4
    either, valid = np.empty(8 * width, np.uint8), np.empty(12 * width, np.uint8)
    sums = np.empty(6 * width, np.uint16)
    reach = (columns.size - width) // 2
    valid_below = valid[wide:]
    for y in range(cells.shape[0]):
        line, upper, lower = cells[y], half[2 * y], half[2 * y + 1]
        for part in range(2):
            first, second = mask[4 * y + 2 * part], mask[4 * y + 2 * part + 1]
            into = either[4 * part * width :]
            for x in range(4 * width):
                into[x] = first[x] | second[x]
        any_bits = np.uint8(0)
        for x in range(either.size):
            any_bits = np.uint8(any_bits | either[x])
        # Usually all pixels are valid, as in the previous line.
        if any_bits or y == 0 or masked[y - 1]:
            for x in range(4 * width):
                kept = np.uint8(0) if either[2 * x] | either[2 * x + 1] else np.uint8(255)
                valid[3 * x] = kept
                valid[3 * x + 1] = kept
                valid[3 * x + 2] = kept
        masked[y] = any_bits != 0
        for x in range(wide):
            sums[x] = (upper[x] & valid[x]) + (lower[x] & valid_below[x])
        first, second, third = line[reach:], line[section + reach :], line[2 * section + reach :]
        weight = line[3 * section + reach :]
        for x in range(width):
            first[x] = sums[6 * x] + sums[6 * x + 3]
            second[x] = sums[6 * x + 1] + sums[6 * x + 4]
            third[x] = sums[6 * x + 2] + sums[6 * x + 5]
        for x in range(width):
            weight[x] = valid[6 * x] + valid[6 * x + 3] + valid_below[6 * x] + valid_below[6 * x + 3]
        for start in range(0, 4 * section, section):
            part_of_line = line[start:]
            for x in range(reach):
                part_of_line[x] = part_of_line[columns[x]]
                part_of_line[reach + width + x] = part_of_line[columns[reach + width + x]]


@kernel("boolean(uint16[:, ::1], boolean[::1], int64[::1], int64, int64, float32, float32, float32[:, ::1])")
def sum_windows(
    cells: Sums,
    masked: Flags,
    rows: Indices,
    reach: int,
    width: int,
    far: float,
    least: float,
    windows: Floats32,
) -> bool:
    """Binomial windows of 3 x 3 cells plus `far` times windows of 2 reach + 1 cells each way.

    cells : (h, 4 sections) and masked : (h,), from `sum_valid`. rows : (h + 2 reach + 2,), indices of lines
    from -reach - 1 on, reflected at the borders. windows : (h, 4 sections) is filled in masked lines and
    those beside them; each section starts with its first cell, and only its first `width` cells are defined.
    Returns whether a weight is below `least`.
    """
    height, long = windows.shape
    last = height - 1
    tall, near = np.empty(long + 2 * reach, np.uint16), np.empty(long + 2 * reach, np.uint16)
    tall[:] = near[:] = 0
    for y in range(2 * reach + 1):
        line = cells[rows[y]]
        for x in range(long):
            tall[x] += line[x]
    left, middle, right = near[reach - 1 :], near[reach:], near[reach + 1 :]
    few = np.uint8(0)
    for y in range(height):
        before, line = cells[rows[y]], cells[rows[y + 2 * reach + 1]]
        for x in range(long):
            tall[x] += line[x] - before[x]
        if not (masked[max(y - 1, 0)] or masked[y] or masked[min(y + 1, last)]):
            continue
        out = windows[y]
        # Sums of integers below 2**24 are exact in any order.
        for x in range(long):
            out[x] = np.float32(tall[x])
        for step in range(1, 2 * reach, 2):
            first, second = tall[step:], tall[step + 1 :]
            for x in range(long):
                out[x] += np.float32(first[x] + second[x])
        above, here, below = cells[rows[y + reach]], cells[y], cells[rows[y + reach + 2]]
        for x in range(long):
            near[x] = above[x] + 2 * here[x] + below[x]
        for x in range(long):
            out[x] = np.float32(np.uint16(left[x] + 2 * middle[x] + right[x])) + far * out[x]
        weight = out[3 * long // 4 :]
        for x in range(width):
            few = np.uint8(few | (weight[x] < least))
    return bool(few)


@kernel(f"void({_READ}, boolean[::1], float32[:, ::1], uint8[:, ::1])")
def fill_masked(mask: Bytes, masked: Flags, windows: Floats32, picture: Bytes) -> None:
    """Set masked px to the sums over their weight, interpolated between the centres of cells.

    mask : (4 h, 4 w). masked : (h,) and windows : (h, 4 sections), from `sum_windows`, overwritten by the
    quotients. picture : (4 h, 12 w).
    """
    height, width, section = windows.shape[0], mask.shape[1] // 4, windows.shape[1] // 4
    line, fill = np.empty(3 * section + 2, np.float32), np.empty(12 * section, np.uint8)
    line[:] = 0
    last = height - 1
    for y in range(height):
        if masked[max(y - 1, 0)] or masked[y] or masked[min(y + 1, last)]:
            weight = windows[y, 3 * section :]
            for x in range(width):
                line[x] = np.float32(255) / weight[x]
            for start in range(0, 3 * section, section):
                part = windows[y, start:]
                for x in range(width):
                    part[x] *= line[x]
    most, rest = np.float32(0.75), np.float32(0.25)
    inner = line[1:]
    colours, chosen = np.empty(12 * width, np.uint8), np.empty(12 * width, np.uint8)
    for y in range(2 * height):
        cell = y // 2
        if not masked[cell]:
            continue
        here, beyond = windows[cell], windows[max(cell - 1, 0) if y % 2 == 0 else min(cell + 1, last)]
        for x in range(3 * section):
            inner[x] = most * here[x] + rest * beyond[x]
        # Replicate the ends of each section into its margins.
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
        for x in range(4 * width):
            colours[3 * x] = blue[x]
            colours[3 * x + 1] = green[x]
            colours[3 * x + 2] = red[x]
        for row in (2 * y, 2 * y + 1):
            hidden, values = mask[row], picture[row]
            for x in range(4 * width):
                bits = np.uint8(255) if hidden[x] else np.uint8(0)
                chosen[3 * x] = bits
                chosen[3 * x + 1] = bits
                chosen[3 * x + 2] = bits
            # Selecting by bits takes a tenth of the time of a branch.
            for x in range(12 * width):
                values[x] ^= (values[x] ^ colours[x]) & chosen[x]
