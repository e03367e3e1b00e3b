"""Pictures as means over a coarse grid of cells, independent of their resolution."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32

LONG_SIDE_CELLS: Final = 128
"""Cells along the longer side of a picture."""
MASKED_MEAN_GREY: Final = 127
"""Mean of a mask, 0 to 255, above which a cell counts as masked."""


def grid_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """(h, w) of the grid for a picture (H, W, ...).

    >>> grid_size((240, 320, 3))
    (96, 128)
    """
    scale = LONG_SIDE_CELLS / max(shape[:2])
    return max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale))


def to_cells(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats32:
    """(h, w, ...) float32: means over cells; interpolated where a picture is smaller than the grid."""
    how = cv2.INTER_AREA if picture.shape[0] >= size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size[::-1], interpolation=how), np.float32)


def to_planes(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats32:
    """(3, h, w) float32 of a picture (H, W, 3)."""
    return np.stack(cv2.split(to_cells(picture, size)))
