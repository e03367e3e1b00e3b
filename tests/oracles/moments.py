"""Plain versions of the kernels of the contact's shape."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.moments import measure_region, wrap_rows
from tests.oracles.gains import Gain


def plain_measure_region(mask: NDArray[np.uint8], ends: NDArray[np.int32]) -> tuple[float, ...]:
    """Bounding box, number, and sums of x, y, x^2, x y, y^2 of the pixels of a mask; its regions counted."""
    left, top, width, height = cv2.boundingRect(mask)
    ends[:] = mask.shape[1], -1
    if width == 0:
        return (0,) * 11
    window = mask[top : top + height, left : left + width]
    sums = cv2.moments(window, binaryImage=True)
    raw = [sums[name] for name in ("m00", "m10", "m01", "m20", "m11", "m02")]
    rows = [np.flatnonzero(row) for row in window]
    for y, row in enumerate(rows):
        if len(row):
            ends[top + y] = left + row[0], left + row[-1]
    runs = all(len(row) and len(row) == row[-1] + 1 - row[0] for row in rows)
    return left, top, width, height, *raw, runs and cv2.connectedComponents(window)[0] == 2


def plain_wrap_rows(
    ends: NDArray[np.int32], left: int, above: int, corners: NDArray[np.float64]
) -> tuple[int, float]:
    """OpenCV's convex hull of the ends, and the pixels of the hull, filled."""
    rows = np.flatnonzero(ends[:, 1] >= 0)
    places = np.column_stack([ends[rows].T.ravel() + left, np.tile(rows, 2) + above]).astype(np.int32)
    hull = cv2.convexHull(places)[:, 0]
    at = np.flatnonzero((hull == places[0]).all(axis=1))[0]
    hull = np.roll(hull, -at - 1, axis=0)
    corners[: len(hull) + 1] = np.vstack([hull[-1:], hull])
    sides = np.abs(np.diff(hull, axis=0, append=hull[:1])).tolist()
    on_border = sum(math.gcd(*side) for side in sides)
    return len(hull) + (len(hull) > 1), cv2.contourArea(hull) + on_border / 2 + 1


GAINS = [
    Gain(measure_region, plain_measure_region),
    Gain(wrap_rows, plain_wrap_rows, scratch=("corners",)),
]
