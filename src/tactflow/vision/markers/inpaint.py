"""Removal of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

import math
import threading
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.geometry.downsample import halve_block, halved
from tactflow.vision.markers.inpaint_kernels import fill_masked, sum_valid, sum_windows
from tactflow.vision.markers.mask import doubled, halved_mask

InpaintMethod = Literal["telea", "ns", "normalized", "none"]

RADIUS = 7.0
"""Neighbourhood from which a marker is filled unless said otherwise, px: that of the original script."""

_CELL = 4
"""Side of the blocks on which averages are formed, px."""
_FAR = 0.01
"""Weight of the wide window against the near neighbours."""
_TRACE = np.float32(1e-6)
"""Weight of the mean of the whole frame: where a window has no valid pixel at all."""
_LEAST = 1e-3
"""Weight below which a window may as well have no valid pixel; one in 10 000 gives more."""


def remove_markers(
    image: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    *,
    method: InpaintMethod = "normalized",
    radius: float = RADIUS,
) -> NDArray[np.uint8]:
    """Replace masked pixels by what surrounds them.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    mask : (H, W) uint8, non-zero where the image is to be replaced.
    method : `telea` marches inwards from the rim (10 ms and more); `ns` continues lines
        of equal brightness by a Navier-Stokes analogy (as slow); `normalized` takes a smooth average of the
        valid pixels around (below 0.2 ms, or 0.1 ms with numba, and closer to the truth where the gel is
        smooth, because it looks at more than the soft rim of a dot); `none` hands the image on.
    radius : neighbourhood, px, > 0. For `telea` and `ns` the distance from which colours are taken. For
        `normalized` the scale of the average: about the radius of a dot; a larger one is smoother, a much
        smaller one leaves the middle of a dot to its far surroundings.

    Returns
    -------
    unmarked : (H, W, 3) uint8, a new array; equal to `image` wherever `mask` is 0. `normalized` computes in
        float32 and gives what float64 would, to 1 grey level.

    Raises
    ------
    ValueError : if image and mask do not fit together, or the radius is not positive.

    References
    ----------
    A. Telea, "An image inpainting technique based on the fast marching method", 2004.
    M. Bertalmio et al., "Navier-Stokes, fluid dynamics, and image and video inpainting", CVPR 2001.
    H. Knutsson, C.-F. Westin, "Normalized and differential convolution", CVPR 1993.
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
    if method == "none":
        return image.copy()
    if method == "normalized":
        return _normalized(image, mask, radius)
    flag = cv2.INPAINT_TELEA if method == "telea" else cv2.INPAINT_NS
    if not mask.any():
        return image.copy()
    return np.asarray(
        cv2.inpaint(np.ascontiguousarray(image), np.ascontiguousarray(mask), radius, flag), np.uint8
    )


def _normalized(image: NDArray[np.uint8], mask: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """Normalized convolution on means over 4 x 4 px: sum of the valid over their weight."""
    height, width = mask.shape
    bottom, right = -height % _CELL, -width % _CELL
    hidden = np.ascontiguousarray(mask)
    if not (bottom or right):
        return _fill_cells(image.copy(), hidden, radius)
    frame = (0, bottom, 0, right, cv2.BORDER_REPLICATE)
    whole = np.asarray(cv2.copyMakeBorder(image, *frame), np.uint8)
    hidden = np.asarray(cv2.copyMakeBorder(hidden, *frame), np.uint8)
    return np.ascontiguousarray(_fill_cells(whole, hidden, radius)[:height, :width])


def _fill_cells(whole: NDArray[np.uint8], mask: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """`_normalized` for a picture of whole cells, which is written over and returned."""
    reach = math.ceil(radius / _CELL + 1)
    if compiled.active():
        return _fill_compiled(whole, mask, reach)
    half = (mask.shape[1] // 2, mask.shape[0] // 2)
    quarter = (half[0] // 2, half[1] // 2)
    # Only whole 2 x 2 blocks count: the soft rim of a marker is left out with it.
    valid = cv2.bitwise_not(halved_mask(mask))
    # The fourth channel carries the weight: 255 where valid, else 0.
    picture = cv2.cvtColor(halved(whole), cv2.COLOR_BGR2BGRA)
    kept = cv2.copyTo(picture, valid).astype(np.float32)
    total = np.asarray(cv2.resize(kept, quarter, interpolation=cv2.INTER_AREA), np.float32)
    # Near neighbours decide wherever there are any; the wide window fills the rest.
    size = 2 * reach + 1
    mixed = cv2.scaleAdd(cv2.blur(total, (size, size)), _FAR, cv2.GaussianBlur(total, (3, 3), 0))
    weight = cv2.extractChannel(mixed, 3)
    if cv2.minMaxLoc(weight)[0] < _LEAST:
        everywhere = np.asarray(cv2.mean(total), np.float32)
        if everywhere[3] == 0:
            return whole
        mixed = np.asarray(mixed + _TRACE * everywhere, np.float32)
        weight = cv2.extractChannel(mixed, 3)
    filled = cv2.divide(mixed, cv2.merge([weight] * 4), scale=255)
    finer = np.asarray(cv2.convertScaleAbs(cv2.resize(filled, half, interpolation=cv2.INTER_LINEAR)))
    # Every pixel twice along a line, as whole numbers of four bytes, then every line twice.
    pixels = finer.view(np.int32)
    lines = cv2.merge([pixels, pixels]).reshape(half[1], -1).view(np.uint8).reshape(half[1], -1, 4)
    large = doubled(np.asarray(cv2.cvtColor(lines, cv2.COLOR_BGRA2BGR), np.uint8))
    cv2.copyTo(large, mask, whole)
    return whole


class _Buffers:
    """What `_fill_compiled` computes in; see the kernels."""

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


def _fill_compiled(whole: NDArray[np.uint8], mask: NDArray[np.uint8], reach: int) -> NDArray[np.uint8]:
    """`_fill_cells` by kernels, with whole numbers where it has means: 64 times its weights."""
    height, width = mask.shape[0] // _CELL, mask.shape[1] // _CELL
    kind = (height, width, reach)
    if getattr(_kept, "kind", None) != kind:
        _kept.kind, _kept.buffers = kind, _Buffers(*kind)
    own: _Buffers = _kept.buffers
    section = width + 2 * reach
    picture = whole.reshape(len(whole), -1)
    halve_block(picture, 0, 0, own.half, 0, 0, 2 * height, 2 * width, False)
    sum_valid(mask, own.either, own.valid, own.half, own.cells, reach, own.masked)
    far = _FAR * 16 / (2 * reach + 1) ** 2
    few = sum_windows(own.cells, reach, own.rows, own.columns, far, 64 * _LEAST, own.lines, own.sums)
    if few:
        inner = own.cells.reshape(-1, 4, section)[reach : reach + height, :, reach : reach + width]
        everywhere = inner.mean(axis=(0, 2), dtype=np.float64).astype(np.float32)
        if everywhere[3] == 0:
            return whole
        own.sums.reshape(height, 4, section)[:] += 16 * _TRACE * everywhere[:, None]
    fill_masked(mask, own.masked, own.sums, section, own.line, own.fill, picture)
    return whole
