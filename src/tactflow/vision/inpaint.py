"""Removal of markers: fill masked pixels from their surroundings."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

InpaintMethod = Literal["telea", "ns", "normalized", "none"]

SEED_RADIUS = 7
"""Inpainting radius of the original script, px."""


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
    unmarked : (H, W, 3) uint8, a new array; equal to `image` wherever `mask` is 0.

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
    if not radius > 0:
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
    """Normalized convolution on a half-size copy: sum of valid pixels over their number."""
    unmarked = image.copy()
    height, width = mask.shape
    half = ((width + 1) // 2, (height + 1) // 2)
    valid = cv2.bitwise_not(mask)
    kept = cv2.resize(cv2.bitwise_and(image, image, mask=valid), half, interpolation=cv2.INTER_AREA)
    weight = cv2.resize(valid, half, interpolation=cv2.INTER_AREA)
    size = 2 * max(1, round(radius)) + 1
    total = cv2.blur(kept.astype(np.float32), (size, size))
    share = cv2.blur(weight.astype(np.float32), (size, size))
    filled = total * (np.float32(255) / np.maximum(share, np.float32(1e-3)))[..., None]
    large = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    cv2.copyTo(np.clip(large + np.float32(0.5), 0, 255).astype(np.uint8), mask, unmarked)
    return unmarked
