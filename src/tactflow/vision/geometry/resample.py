"""Resampling of a picture through a whole mapping at once."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats
from tactflow.vision.geometry.mapping import PixelMapping

_OUTSIDE_COORDINATE_PX: Final = -10.0
"""Coordinate, px, that stands for places outside the raw frame: far enough that no sample reaches inside."""
_HORIZON_DEPTH_SHARE: Final = 1e-9
"""Share of the largest homogeneous depth below which a pixel counts as beyond the horizon. Chosen by hand."""


class Resampler:
    """Carries out a whole mapping by one `cv2.remap`, after averaging over blocks where the mapping shrinks.

    Sampling is bilinear, at positions rounded to 1/32 px. What lies outside the raw frame becomes black.
    Raises ValueError where the processed frame shows nothing of the raw frame.

    >>> resample = Resampler(PixelMapping.identity((4, 3)))
    >>> resample(np.full((3, 4, 3), 7, np.uint8)).mean()
    np.float64(7.0)
    """

    def __init__(self, mapping: PixelMapping) -> None:
        size = np.array(mapping.raw_size)
        grid = np.stack(np.meshgrid(*map(np.arange, mapping.size)), axis=-1).reshape(-1, 2).astype(np.float64)
        raw = mapping.to_raw(grid)
        inside = _in_front(mapping, grid) & ((raw >= -0.5) & (raw <= size - 0.5)).all(axis=1)
        if not inside.any():
            raise ValueError("required the processed frame to show some of the raw frame, got none of it")
        # How many raw pixels one processed pixel spans along raw x and raw y, in the median.
        right, down = (mapping.to_raw(grid[inside] + step) for step in ((1, 0), (0, 1)))
        span = np.median(np.hypot(right - raw[inside], down - raw[inside]), axis=0)
        self._block = np.clip(np.rint(span), 1, size).astype(int)
        self._small = size // self._block
        # Inside the raw frame the outermost averaged pixel extends to the frame's edge; outside stays black.
        small = np.clip((raw - (self._block - 1) / 2) / self._block, 0, self._small - 1.0)
        small[~inside] = _OUTSIDE_COORDINATE_PX
        x, y = small.reshape(*mapping.size[::-1], 2).transpose(2, 0, 1).astype(np.float32)
        self._maps = cv2.convertMaps(np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.CV_16SC2)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        """The picture (h, w, 3) uint8 of a raw frame (H, W, 3) uint8."""
        source: NDArray[Any] = image
        if self._block.max() > 1:
            width, height = (self._small * self._block).tolist()
            source = cv2.resize(image[:height, :width], self._small.tolist(), interpolation=cv2.INTER_AREA)
        return cv2.remap(source, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _in_front(mapping: PixelMapping, grid: Floats) -> Flags:
    """False for processed pixels beyond the horizon of the homography, where it folds over."""
    back = np.linalg.inv(mapping.matrix)
    depth = grid @ back[2, :2] + back[2, 2]
    center = np.array([(mapping.raw_size[0] - 1) / 2, (mapping.raw_size[1] - 1) / 2, 1.0])
    sign = np.sign(mapping.matrix[2] @ center) or 1.0
    return np.asarray(depth * sign > _HORIZON_DEPTH_SHARE * float(np.abs(depth).max()))
