"""Removal of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

InpaintMethod = Literal["telea", "ns", "normalized", "none"]

SEED_RADIUS = 7
"""Inpainting radius of the original script, px."""

_CELL = 4
"""Side of the blocks on which averages are formed, px."""
_FAR = 0.01
"""Weight of the wide window against the near neighbours."""
_TRACE = 1e-6
"""Weight of the mean of the whole frame: where a window has no valid pixel at all."""


def remove_markers(
    image: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    *,
    method: InpaintMethod = "normalized",
    radius: float = SEED_RADIUS,
) -> NDArray[np.uint8]:
    """Replace masked pixels by what surrounds them.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    mask : (H, W) uint8, non-zero where the image is to be replaced.
    method : `telea` marches inwards from the rim (the seed's choice, 10 ms and more); `ns` continues lines
        of equal brightness by a Navier-Stokes analogy (as slow); `normalized` takes a smooth average of the
        valid pixels around (below 0.2 ms, and closer to the truth where the gel is smooth, because it looks
        at more than the soft rim of a dot); `none` hands the image on.
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
    Seed function `inpaint`.
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
    unmarked = image.copy()
    bottom, right = -height % _CELL, -width % _CELL
    whole, hidden = unmarked, np.ascontiguousarray(mask)
    if bottom or right:
        frame = (0, bottom, 0, right, cv2.BORDER_REPLICATE)
        whole = np.asarray(cv2.copyMakeBorder(unmarked, *frame), np.uint8)
        hidden = np.asarray(cv2.copyMakeBorder(hidden, *frame), np.uint8)
    half = ((width + right) // 2, (height + bottom) // 2)
    quarter = (half[0] // 2, half[1] // 2)
    # Only whole 2 x 2 blocks count: the soft rim of a marker is left out with it.
    valid = cv2.inRange(cv2.resize(hidden, half, interpolation=cv2.INTER_AREA), (0.0,), (0.0,))
    kept = cv2.copyTo(cv2.resize(whole, half, interpolation=cv2.INTER_AREA), valid)
    # At a scale of two, linear interpolation is the mean of 2 x 2, and faster than the area method here.
    total = cv2.resize(kept.astype(np.float32), quarter, interpolation=cv2.INTER_LINEAR)
    weight = cv2.resize(valid.astype(np.float32), quarter, interpolation=cv2.INTER_LINEAR)
    if not cv2.countNonZero(weight):
        return unmarked
    # Near neighbours decide wherever there are any; the wide window and the mean of all fill the rest.
    size = 2 * math.ceil(radius / _CELL + 1) + 1
    colours = _smoothed(np.asarray(total, np.float32), size)
    shares = _smoothed(np.asarray(weight, np.float32), size)
    filled = cv2.convertScaleAbs(cv2.divide(colours, cv2.merge([shares, shares, shares]), scale=255))
    large = cv2.resize(filled, (width + right, height + bottom), interpolation=cv2.INTER_LINEAR)
    cv2.copyTo(large[:height, :width], mask, unmarked)
    return unmarked


def _smoothed(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Mean over the near cells, with a trace of the wide window's and of the whole frame's."""
    near = cv2.GaussianBlur(values, (3, 3), 0)
    mixed = cv2.scaleAdd(cv2.blur(values, (size, size)), _FAR, near)
    everywhere = np.asarray(cv2.mean(values), np.float32) * np.float32(_TRACE)
    # Not by cv2.add, which takes an array of four numbers for a colour.
    return np.asarray(mixed + (everywhere[:3] if values.ndim == 3 else everywhere[0]), np.float32)
