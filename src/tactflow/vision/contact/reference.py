"""Detect a reference that was touched: pressing a gel makes it rougher, never smoother."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.contact.cells import MASKED_MEAN_GREY, grid_size, to_cells, to_planes

TOUCHED_ROUGHNESS_RATIO: Final = 0.5
"""Ratio of a region's roughness to that in the reference below which the reference was touched there. With
reference and contact exchanged, 83 % of 166 outlined contacts of fifteen labs are noticed; not exchanged, one
is a false alarm."""
UNTOUCHED_ROUGHNESS_RATIO: Final = 1.25
"""Ratio above which the reference is known to be untouched from then on."""
UNTOUCHED_FRAMES: Final = 10
"""Number of frames with a contact that is not smoother, after which the same holds: a touch in the reference
is released before another contact begins. Chosen by hand."""


class ReferenceCheck:
    """Compares the roughness of changed regions with that of the same places in the reference.

    Parameters
    ----------
    reference : (H, W, 3) uint8 BGR, without markers.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> scene = open_scene("unmarked")
    >>> free, touched = scene.frame(0), scene.frame(60)
    >>> changed = cv2.inRange(cv2.absdiff(free, touched).max(axis=2), 20, 255)
    >>> ReferenceCheck(touched).was_touched(free, changed), ReferenceCheck(free).was_touched(touched, changed)
    (True, False)
    """

    def __init__(self, reference: NDArray[np.uint8]) -> None:
        self._size = grid_size(reference.shape)
        self._slopes = _squared_slopes(reference, self._size)
        self._passed = 0
        self.confirmed = False
        """Whether contacts have shown that the reference is untouched."""

    def was_touched(self, image: NDArray[np.uint8], changed: Mask) -> bool:
        """Whether the gel is smoother than in the reference in the changed region.

        image : (H, W, 3) uint8 BGR, of the reference's size, without markers. changed : (H, W) uint8.
        """
        if self.confirmed:
            return False
        region = to_cells(changed, self._size) > MASKED_MEAN_GREY
        if not region.any():
            return False
        now = float(_squared_slopes(image, self._size)[:, region].sum())
        before = float(self._slopes[:, region].sum())
        ratio = now / before if before > 0 else math.inf
        self._passed += ratio >= TOUCHED_ROUGHNESS_RATIO
        self.confirmed = ratio > UNTOUCHED_ROUGHNESS_RATIO or self._passed == UNTOUCHED_FRAMES
        return ratio < TOUCHED_ROUGHNESS_RATIO


def _squared_slopes(image: NDArray[np.uint8], size: tuple[int, int]) -> Floats32:
    """Squared gradient (channels, h, w) of the logarithm of the light, smoothed by one cell against noise."""
    planes = np.log(to_planes(image, size) + 1)
    smooth = [cv2.GaussianBlur(plane, (0, 0), 1.0) for plane in planes]
    slopes = [cv2.Sobel(p, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(p, cv2.CV_32F, 0, 1) ** 2 for p in smooth]
    return np.asarray(slopes, np.float32)
