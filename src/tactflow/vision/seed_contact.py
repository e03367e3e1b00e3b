"""The original script's marker mask and contact mask, kept literally as the yardstick."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SEED_MASK_THRESHOLD = 120
"""Amplified difference of Gaussians above which a channel votes for a marker, grey levels."""

SEED_BRIGHTER_BY = 14
"""Smallest brightening, grey levels, that the seed's threshold of 140 lets through."""

_FIVE = np.ones((5, 5), np.uint8)
_NINE = np.ones((9, 9), np.uint8)


def _require_bgr(image: NDArray[np.uint8], name: str = "image") -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"{name}: required a non-empty (H, W, 3) uint8 array, got {image.shape} {image.dtype}"
        )


def seed_marker_mask(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mask of dark markers, as the original script computes it.

    The image is halved, blurred with Gaussians of 25 and 15 px, their difference is amplified 20 times and
    clipped, each channel votes where it exceeds 120, and two votes of three make a marker. The mask is
    enlarged with OpenCV's default interpolation, which carries a half-pixel shift.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.

    Returns
    -------
    mask : (H, W) uint8, 255 on markers, else 0. In float32, as the original; float64 would move its border by
        at most 1 px.

    Raises
    ------
    ValueError : if the image is not of that kind.

    References
    ----------
    Seed function `mask_marker`.
    """
    _require_bgr(image)
    height, width = image.shape[:2]
    small = cv2.pyrDown(np.ascontiguousarray(image)).astype(np.float32)
    blur = cv2.GaussianBlur(small, (25, 25), 0)
    blur2 = cv2.GaussianBlur(small, (15, 15), 0)
    amplified = np.clip((blur - blur2) * np.float32(20), 0, 255)
    blue, green, red = (amplified[..., channel] > SEED_MASK_THRESHOLD for channel in range(3))
    votes = (blue & green) | (blue & red) | (green & red)
    enlarged = cv2.resize(votes.astype(np.uint8), (width, height))
    return np.asarray(enlarged * np.uint8(255), np.uint8)


def seed_difference(
    unmarked: NDArray[np.uint8], reference: NDArray[np.uint8], *, lower_bound: float = 0.5, scale: float = 0.7
) -> NDArray[np.uint8]:
    """Contact mask, step by step in floating point as the original script computes it.

    Slow; `seed_contact_mask` gives the same mask in integer arithmetic. Values outside 0..255 are clipped
    before they become uint8 (converting them unclipped is undefined, and differs between processors).

    Parameters
    ----------
    unmarked : (H, W, 3) uint8, the frame without markers, BGR grey levels.
    reference : same shape, the untouched gel without markers.
    lower_bound : value that stands for "no change" in the normalised difference, 0..1.
    scale : factor on negative differences, 0..1; it changes nothing after the threshold of 140.

    Returns
    -------
    mask : (H, W) uint8, 255 in contact, else 0.

    References
    ----------
    Seed function `difference`.
    """
    _require_bgr(unmarked, "unmarked")
    diff = (unmarked * 1.0 - reference) / 255.0 + lower_bound
    below = diff < lower_bound
    diff[below] = (diff[below] - lower_bound) * scale + lower_bound
    levels = np.clip(diff * 255, 0, 255).astype(np.uint8)
    levels[levels > 140] = 255
    levels[levels <= 140] = 0
    blue, green, red = cv2.split(levels)
    # A channel dominates where it exceeds another one; what no channel dominates is grey: contact.
    dominated = (blue > green) | (blue > red) | (green > blue) | (green > red) | (red > blue) | (red > green)
    neutral = np.where(dominated, 0, 255).astype(np.uint8)
    gray = cv2.cvtColor(cv2.bitwise_and(levels, levels, mask=neutral), cv2.COLOR_BGR2GRAY)
    _, binary = cv2.threshold(gray, 50, 255, cv2.THRESH_BINARY)
    eroded = cv2.erode(binary, _FIVE, iterations=2)
    return np.asarray(cv2.dilate(eroded, _FIVE, iterations=1), np.uint8)


def seed_contact_mask(unmarked: NDArray[np.uint8], reference: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Contact mask of the original script, in saturating integer arithmetic.

    The seed's chain of floating-point steps says: brighter by at least 14 grey levels in all three
    channels, then eroded twice and dilated once by 5 x 5. That is what is computed; two erosions by 5 x 5
    are one by 9 x 9.

    Parameters
    ----------
    unmarked : (H, W, 3) uint8, the frame without markers, BGR grey levels.
    reference : same shape, the untouched gel without markers.

    Returns
    -------
    mask : (H, W) uint8, 255 in contact, else 0; equal to `seed_difference`, bit for bit.

    Raises
    ------
    ValueError : if the two are not images of the same size.
    """
    _require_bgr(unmarked, "unmarked")
    if reference.shape != unmarked.shape:
        raise ValueError(f"required a reference of shape {unmarked.shape}, got {reference.shape}")
    brighter = cv2.subtract(unmarked, reference)
    floor = (SEED_BRIGHTER_BY,) * 3
    binary = cv2.inRange(brighter, floor, (255,) * 3)
    return np.asarray(cv2.dilate(cv2.erode(binary, _NINE), _FIVE), np.uint8)
