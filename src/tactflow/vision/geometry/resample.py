"""Resampling of a picture through a whole mapping at once."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats
from tactflow.vision.geometry.mapping import PixelMapping

_LARGEST_FIXED_POINT: Final = 32000
"""Side of a picture, px, up to which maps are in fixed point. Derived: their 16-bit signed entries reach
32767, less a margin."""
_BEHIND: Final = -1e4
"""Raw coordinate, px, that stands for places beyond the horizon of the homography: outside any frame."""
_OUTSIDE: Final = -10.0
"""Coordinate, px, that stands for places outside the raw frame: far enough that no sample reaches inside."""
_SPAN_SAMPLES: Final = 2000
"""Processed pixels, about, at which the local scale is measured; its median needs no more. Chosen by hand."""
_HORIZON: Final = 1e-9
"""Share of the largest homogeneous depth below which a pixel counts as beyond the horizon. Chosen by hand."""


class Resampler:
    """One `cv2.remap` that carries out a whole mapping, with block averaging before it where it shrinks.

    Sampling is bilinear, at positions rounded to 1/32 px. What lies outside the raw frame becomes black.
    Raises ValueError where the processed frame shows nothing of the raw frame.

    >>> resample = Resampler(PixelMapping.identity((4, 3)))
    >>> resample(np.full((3, 4, 3), 7, np.uint8)).mean()
    np.float64(7.0)
    """

    def __init__(self, mapping: PixelMapping) -> None:
        width, height = mapping.size
        raw_width, raw_height = mapping.raw_size
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        grid = np.column_stack([columns.ravel(), rows.ravel()])
        raw = mapping.to_raw(grid)
        in_front = _in_front(mapping, grid)
        raw[~in_front] = _BEHIND
        self._block = _shrinkage(mapping, raw.reshape(height, width, 2), in_front.reshape(height, width))
        fx, fy = self._block
        self._small = (raw_width // fx, raw_height // fy)
        self._used = (slice(0, self._small[1] * fy), slice(0, self._small[0] * fx))
        # Inside the raw frame the outermost averaged pixel extends to the frame's edge; outside stays black.
        inside = _inside(raw, mapping.raw_size)
        small = (raw - [(fx - 1) / 2, (fy - 1) / 2]) / [fx, fy]
        small[inside] = np.clip(small[inside], 0, np.array(self._small) - 1.0)
        small[~inside] = _OUTSIDE
        map_x = small[:, 0].reshape(height, width).astype(np.float32)
        map_y = small[:, 1].reshape(height, width).astype(np.float32)
        self._maps: tuple[Any, Any] = (map_x, map_y)
        if max(self._small) <= _LARGEST_FIXED_POINT:
            self._maps = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """The picture (h, w, 3) uint8 of a raw frame (H, W, 3) uint8."""
        source: NDArray[Any] = image
        if self._block != (1, 1):
            source = cv2.resize(image[self._used], self._small, interpolation=cv2.INTER_AREA)
        return cv2.remap(
            source, self._maps[0], self._maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )


def _inside(raw: Floats, raw_size: tuple[int, int]) -> NDArray[np.bool_]:
    """(...,) bool: which of (..., 2) points lie on a pixel of a frame of size (width, height)."""
    inside: NDArray[np.bool_] = (
        (raw[..., 0] >= -0.5)
        & (raw[..., 0] <= raw_size[0] - 0.5)
        & (raw[..., 1] >= -0.5)
        & (raw[..., 1] <= raw_size[1] - 0.5)
    )
    return inside


def _shrinkage(mapping: PixelMapping, raw: Floats, in_front: NDArray[np.bool_]) -> tuple[int, int]:
    """How many raw pixels one processed pixel spans along raw x and raw y, rounded; median over the frame."""
    seen = in_front & _inside(raw, mapping.raw_size)
    if not seen.any():
        raise ValueError("required the processed frame to show some of the raw frame, got none of it")
    rows, columns = np.nonzero(seen)
    grid = np.column_stack([columns, rows]).astype(np.float64)
    grid = grid[:: max(1, len(grid) // _SPAN_SAMPLES)]
    half_right, half_down = np.diag([0.5, 0.5])
    right = mapping.to_raw(grid + half_right) - mapping.to_raw(grid - half_right)
    down = mapping.to_raw(grid + half_down) - mapping.to_raw(grid - half_down)
    span = np.median(np.hypot(right, down), axis=0)
    fx, fy = np.clip(np.rint(span), 1, np.array(mapping.raw_size)).astype(int)
    return int(fx), int(fy)


def _in_front(mapping: PixelMapping, grid: Floats) -> NDArray[np.bool_]:
    """False for processed pixels beyond the horizon of the homography, where it folds over."""
    back = np.linalg.inv(mapping.matrix)
    depth = grid @ back[2, :2] + back[2, 2]
    centre = np.array([(mapping.raw_size[0] - 1) / 2, (mapping.raw_size[1] - 1) / 2, 1.0])
    sign = np.sign(mapping.matrix[2] @ centre) or 1.0
    front: NDArray[np.bool_] = depth * sign > _HORIZON * float(np.abs(depth).max())
    return front
