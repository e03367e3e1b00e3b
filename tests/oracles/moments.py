"""Plain versions of the kernels of the contact's shape."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.moments import measure_region
from tests.oracles.gains import Gain


def plain_measure_region(mask: NDArray[np.uint8], found: NDArray[np.int64]) -> None:
    """Bounding box, number, and sums of x, y, x^2, x y, y^2 of the pixels of a mask, from its corner."""
    left, top, width, height = cv2.boundingRect(mask)
    found[:] = 0
    if width == 0:
        return
    sums = cv2.moments(mask[top : top + height, left : left + width], binaryImage=True)
    raw = [sums[name] for name in ("m00", "m10", "m01", "m20", "m11", "m02")]
    found[:] = [left, top, width, height, *raw]


GAINS = [Gain(measure_region, plain_measure_region)]
