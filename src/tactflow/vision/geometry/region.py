"""What a mask shows: bounding box, number of pixels, outlines and moments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Indices, Mask
from tactflow.vision.compiled import kernel

Contours = Sequence[NDArray[Any]]
"""Outer outlines, each (n, 1, 2) int32, x and y of every pixel on it, px of the frame."""


class Moments(NamedTuple):
    """Centroid (x, y) of a region, px, and the covariance of its pixels, px^2."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float

    @property
    def spread(self) -> float:
        """Difference of the principal variances, px^2."""
        return math.hypot(self.xx - self.yy, 2 * self.xy)

    @property
    def principal(self) -> tuple[float, float]:
        """The principal variances, px^2, the larger one first."""
        major = (self.xx + self.yy + self.spread) / 2
        return major, max(0.0, self.xx * self.yy - self.xy * self.xy) / major if major > 0 else 0.0


class Region(NamedTuple):
    """The pixels of a mask that are set.

    Attributes
    ----------
    left, top, width, height : their bounding box, px; all 0 if there are none.
    pixels : how many.
    window : (height, width) uint8, the part of the mask in that box.
    sums : of x, y, x^2, x y and y^2 over them, px of the frame.
    """

    left: int
    top: int
    width: int
    height: int
    pixels: int
    window: Mask
    sums: tuple[int, ...]

    def contours(self) -> Contours:
        """Outlines of its components (8-connected), without those of holes."""
        if not self.pixels:
            return ()
        offset = (self.left, self.top)
        return cv2.findContours(self.window, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=offset)[0]

    def moments(self) -> Moments:
        """Its moments; there is at least one pixel."""
        # Whole numbers: no cancellation, a vertical bar is exactly vertical.
        count, (x, y, xx, xy, yy) = self.pixels, self.sums
        square = count * count
        return Moments(
            x / count,
            y / count,
            (count * xx - x * x) / square,
            (count * xy - x * y) / square,
            (count * yy - y * y) / square,
        )


def measure_region(mask: Mask) -> Region:
    """Find all pixels of a mask (H, W) uint8 that are not 0.

    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:7, 5:8] = 255
    >>> region = measure_region(mask)
    >>> region.width, region.height, region.pixels
    (3, 2, 6)
    >>> region.moments().x
    6.0
    """
    totals = np.empty(10, np.int64)
    sum_pixels(np.ascontiguousarray(mask), totals)
    left, top, right, bottom, pixels, *sums = totals.tolist()
    window = mask[top:bottom, left:right]
    return Region(left, top, right - left, bottom - top, pixels, window, tuple(sums))


@kernel
def sum_pixels(mask: Mask, totals: Indices) -> None:
    """Measure the pixels of a mask that are not 0.

    mask : (H, W). totals : (10,), filled: the smallest x and y, and the largest plus 1; the number of pixels;
    and the sums of x, y, x^2, x y and y^2 over them. All are 0 without any.
    """
    y, x = np.nonzero(mask)
    totals[:] = 0
    if len(x):
        sums = [values.sum() for values in (x, y, x * x, x * y, y * y)]
        totals[:] = [x.min(), y.min(), x.max() + 1, y.max() + 1, len(x), *sums]
