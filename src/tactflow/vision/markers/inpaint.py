"""Inpainting of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, Literal, get_args

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes, Indices, check_color_image, check_mask
from tactflow.vision.compiled import kernel
from tactflow.vision.geometry.downsample import halved

InpaintMethod = Literal["telea", "ns", "normalized", "none"]
_METHODS: Final = get_args(InpaintMethod)

RADIUS_PX: Final = 7.0
"""Default neighbourhood from which a marker is filled, px: that of the original script."""

CELL_PX: Final = 4
"""Side of the cells over which means are formed, px; hard-coded in the kernels."""

FAR_WEIGHT: Final = 0.01
"""Weight of the wide window relative to the 3 x 3 cells around, which decide wherever one of them is valid.
Chosen by hand."""

FRAME_WEIGHT: Final = 1e-6
"""Weight of the mean of the whole frame, which decides where a window has no valid pixel. Chosen by hand."""

MIN_WEIGHT: Final = 1e-3
"""Weight, of at most 255, below which a window has no valid pixel: one px in 10 000 gives more (derived)."""

MAX_REACH_CELLS: Final = 31
"""Maximum half-width of the wide window, cells, so that sums of its columns fit in 16 bits. Derived: 63 cells
of at most 4 * 255 are below 2**16."""


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
        with a much smaller one the middle of a dot is filled from far away; beyond 120 px it has no further
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
    check_mask(mask, image.shape[:2])
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

    Sums take the place of means, so weights are up to 64 * 255.
    """
    reach = min(math.ceil(radius / CELL_PX + 1), MAX_REACH_CELLS)
    height, width = mask.shape[0] // CELL_PX, mask.shape[1] // CELL_PX
    fill_masked(
        whole.reshape(len(whole), -1),
        mask,
        halved(whole).reshape(2 * height, -1),
        _reflected(height, reach + 1),
        _reflected(width, reach) + reach,
        reach,
        FAR_WEIGHT * 16 / (2 * reach + 1) ** 2,
        64 * MIN_WEIGHT,
        16 * FRAME_WEIGHT,
    )
    return whole


@lru_cache(maxsize=32)
def _reflected(count: int, margin: int) -> Indices:
    """Indices of the cells of a line, extended by reflection by `margin` cells on either side."""
    return np.pad(np.arange(count), margin, mode="reflect")


@kernel
def fill_masked(
    picture: Bytes,
    mask: Bytes,
    half: Bytes,
    rows: Indices,
    columns: Indices,
    reach: int,
    far: float,
    least: float,
    share: float,
) -> None:
    """Replace the masked px of a picture by a mean of the valid ones around, interpolated between cells.

    Weights are 3 x 3 cells, binomial, plus `far` times 2 reach + 1 cells each way; where they have less than
    `least` in common with valid values, `share` times the mean of the picture is added everywhere.

    picture : (4 h, 12 w), overwritten. mask : (4 h, 4 w). half : (2 h, 6 w), the picture at half resolution;
    a value is valid where none of its 2 x 2 px is masked. rows : (h + 2 reach + 2,), lines of cells from
    -reach - 1 on, reflected at the borders. columns : (w + 2 reach,), for each place from -reach on, the
    place from 0 on that it repeats, plus `reach`.
    """
    high, wide = mask.shape[0] // 4, mask.shape[1] // 4
    hidden = mask != 0
    valid = ~hidden.reshape(2 * high, 2, 2 * wide, 2).any(axis=(1, 3))
    values = np.dstack([half.reshape(2 * high, 2 * wide, 3), np.full_like(valid, 255, np.uint8)])
    sums = (values * valid[:, :, None].astype(np.float32)).reshape(high, 2, wide, 2, 4).sum(axis=(1, 3))
    cells = np.ascontiguousarray(sums[rows][:, columns - reach])
    line, inner = np.array([1, 2, 1], np.float32), (slice(reach + 1, -reach - 1), slice(reach, reach + wide))
    windows = cv2.sepFilter2D(cells, cv2.CV_32F, line, line)[inner]
    size = (2 * reach + 1, 2 * reach + 1)
    windows = windows + np.float32(far) * cv2.boxFilter(cells, cv2.CV_32F, size, normalize=False)[inner]
    if (windows[:, :, 3] < least).any():
        everywhere = sums.mean(axis=(0, 1), dtype=np.float64).astype(np.float32)
        if everywhere[3] == 0:
            return
        windows += np.float32(share) * everywhere
    means = np.ascontiguousarray(windows[:, :, :3] * (255 / windows[:, :, 3:]))
    fine = np.rint(cv2.resize(means, (2 * wide, 2 * high), interpolation=cv2.INTER_LINEAR))
    whole = fine.astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)
    picture.reshape(4 * high, 4 * wide, 3)[hidden] = whole[hidden]
