"""Plain versions of the kernels of the search for spots."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.spots import local_maxima, near_others
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]


def plain_local_maxima(
    response: Float32Array, least: float, reach: int, points: FloatArray, height: Float32Array
) -> int:
    """Pixels that a dilation leaves as they are."""
    highest = cv2.dilate(response, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    # Above `least` is the same as at least the next number in this precision.
    np.maximum(highest, np.nextafter(np.float32(least), np.float32(np.inf)), out=highest)
    peak = cv2.compare(response, highest, cv2.CMP_GE)
    peak[0] = peak[-1] = 0
    peak[:, 0] = peak[:, -1] = 0
    at = np.flatnonzero(peak)
    width = response.shape[1]
    rows, columns = np.divmod(at, width)
    room = len(points)
    flat = response.ravel()
    value = flat.take(at)
    for axis, (whole, step) in enumerate(((columns, 1), (rows, width))):
        before, after = flat.take(at - step), flat.take(at + step)
        bend = np.minimum(before + after - 2 * value, np.float32(-1e-6))
        offset = 0.5 * (before - after) / bend
        vertex = whole + np.minimum(np.maximum(offset, -0.5), 0.5)
        points[: len(at), axis] = vertex[:room]
    height[: len(at)] = value[:room]
    return len(at)


def plain_near_others(
    points: FloatArray,
    others: FloatArray,
    scale: float,
    disc: NDArray[np.uint8],
    raster: NDArray[np.uint8],
    found: NDArray[np.bool_],
) -> None:
    """A raster of the others, dilated."""
    limits = np.array([raster.shape[1] - 1, raster.shape[0] - 1])
    column, row = np.clip((others * scale + 0.5).astype(np.int64), 0, limits).T
    raster[row, column] = 1
    wide = np.asarray(cv2.dilate(raster, disc), np.uint8)
    column, row = np.clip((points * scale + 0.5).astype(np.int64), 0, limits).T
    found[:] = wide[row, column] > 0


GAINS = [Gain(local_maxima, plain_local_maxima), Gain(near_others, plain_near_others)]
