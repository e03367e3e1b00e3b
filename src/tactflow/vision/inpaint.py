"""Removal of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.marker_mask import doubled, halved_mask

InpaintMethod = Literal["telea", "ns", "normalized", "none"]

SEED_RADIUS = 7
"""Inpainting radius of the original script, px."""

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
    valid = cv2.bitwise_not(halved_mask(hidden))
    # The fourth channel carries the weight: 255 where valid, else 0.
    picture = cv2.cvtColor(cv2.resize(whole, half, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2BGRA)
    kept = cv2.copyTo(picture, valid).astype(np.float32)
    total = np.asarray(cv2.resize(kept, quarter, interpolation=cv2.INTER_AREA), np.float32)
    # Near neighbours decide wherever there are any; the wide window fills the rest.
    size = 2 * math.ceil(radius / _CELL + 1) + 1
    mixed = cv2.scaleAdd(cv2.blur(total, (size, size)), _FAR, cv2.GaussianBlur(total, (3, 3), 0))
    weight = cv2.extractChannel(mixed, 3)
    if cv2.minMaxLoc(weight)[0] < _LEAST:
        everywhere = np.asarray(cv2.mean(total), np.float32)
        if everywhere[3] == 0:
            return unmarked
        mixed = np.asarray(mixed + _TRACE * everywhere, np.float32)
        weight = cv2.extractChannel(mixed, 3)
    filled = cv2.divide(mixed, cv2.merge([weight] * 4), scale=255)
    finer = np.asarray(cv2.convertScaleAbs(cv2.resize(filled, half, interpolation=cv2.INTER_LINEAR)))
    # Every pixel twice along a line, as whole numbers of four bytes, then every line twice.
    pixels = finer.view(np.int32)
    lines = cv2.merge([pixels, pixels]).reshape(half[1], -1).view(np.uint8).reshape(half[1], -1, 4)
    large = doubled(np.asarray(cv2.cvtColor(lines, cv2.COLOR_BGRA2BGR), np.uint8))
    cv2.copyTo(large[:height, :width], mask, unmarked)
    return unmarked
