"""Which points lie in a mask, or near it."""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.loops import look_up

_ROUNDING: Final = 1e-9
"""Added to a disc's radius, and to half the width of its rows, px, before they are cut to whole pixels: a
whole number keeps its value where it was rounded down. Chosen by hand."""
_FARTHEST: Final = 1e9
"""Reach, px, that takes in all points; computing with a larger one may overflow. Chosen by hand."""


def check_mask(mask: NDArray[np.uint8], dilate: float) -> None:
    """Raise ValueError if mask is not (H, W) uint8, or if dilate, px, is negative or not finite."""
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    if not (dilate >= 0 and math.isfinite(dilate)):
        raise ValueError(f"required dilate >= 0 px, got {dilate}")


def inside_mask(points: NDArray[Any], mask: NDArray[np.uint8], dilate: float = 0.0) -> NDArray[np.bool_]:
    """Which points fall on a pixel that has a non-zero pixel of the mask within `dilate` px.

    points : (N, 2) float, px, x right, y down; points outside the frame are judged by their distance too.
    mask : (H, W) uint8.
    dilate : px, >= 0, between pixel centres.
    Returns (N,) bool. The same as dilating the mask by a disc and looking the points up, at the cost of the
    mask's bounding box instead of the frame. Raises ValueError if mask is not (H, W) uint8, or if dilate is
    negative or not finite.

    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:10, 5:10] = 255
    >>> inside_mask(np.array([[7.2, 7.0], [12.0, 7.0], [15.0, 7.0]]), mask, dilate=3)
    array([ True,  True, False])
    """
    check_mask(mask, dilate)
    inside, dilate = np.zeros(len(points), np.bool_), min(dilate, _FARTHEST)
    reach = math.floor(dilate + _ROUNDING)
    if reach == 0:
        look_up(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(mask), inside)
        return inside
    if len(points) == 0 or mask.size == 0:
        return inside
    left, top, width, height = cv2.boundingRect(mask)
    if width == 0:
        return inside
    pixels = np.rint(points) - (left, top)
    near = np.flatnonzero(
        (pixels[:, 0] >= -reach)
        & (pixels[:, 0] < width + reach)
        & (pixels[:, 1] >= -reach)
        & (pixels[:, 1] < height + reach)
    )
    if len(near) == 0:
        return inside
    x, y = pixels[near].astype(np.intp).T
    roi: NDArray[Any] = mask[top : top + height, left : left + width]
    inside[near] = _near_mask(x, y, roi, dilate)
    return inside


def _near_mask(
    x: NDArray[np.intp], y: NDArray[np.intp], mask: NDArray[Any], dilate: float
) -> NDArray[np.bool_]:
    """Whether the pixels (n,), (n,) have a non-zero pixel of the mask within `dilate` px."""
    height, width = mask.shape
    reach = math.floor(dilate + _ROUNDING)
    # Row by row of the disc, how many mask pixels lie in it, from sums over rectangles.
    ones: NDArray[Any] = cv2.threshold(mask, 0, 1, cv2.THRESH_BINARY)[1]
    sums = np.asarray(cv2.integral(ones))
    # Only rows that the mask has, so that a huge reach costs no more than the mask's height.
    down = np.arange(max(-reach, -int(y.max())), min(reach, height - 1 - int(y.min())) + 1)
    half = np.floor(np.sqrt(np.maximum(dilate**2 - down**2, 0)) + _ROUNDING).astype(np.intp)
    upper = y[:, None] + down
    begin, end = _clip(upper, height), _clip(upper + 1, height)
    first, last = _clip(x[:, None] - half, width), _clip(x[:, None] + half + 1, width)
    found = sums[end, last] - sums[begin, last] - sums[end, first] + sums[begin, first]
    return np.asarray(found.any(axis=1))


def _clip(values: NDArray[np.intp], high: int) -> NDArray[np.intp]:
    # np.clip costs 6 us a call on small arrays, these two 1 us.
    return np.minimum(np.maximum(values, 0), high)
