"""Plain versions of the kernels of the marker mask."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.mask import contrast_with_circle, cover_spots
from tests.oracles.gains import Gain

Bytes = NDArray[np.uint8]


def plain_contrast_with_circle(picture: Bytes, reach: int, steps: NDArray[np.int64], contrast: Bytes) -> None:
    """Erosion by a circle less the picture."""
    high, wide = picture.shape[0], picture.shape[1] // 3
    # Counted from the top left corner of the square around the circle, rows and columns separate.
    rows, columns = np.divmod(steps // 3 + reach * (wide + 1), wide)
    circle = np.zeros((2 * reach + 1, 2 * reach + 1), np.uint8)
    circle[rows, columns] = 1
    pixels = picture.reshape(high, wide, 3)
    least = np.asarray(cv2.subtract(cv2.erode(pixels, circle), pixels), np.uint8)
    inner = (slice(reach, high - reach), slice(reach, wide - reach))
    contrast.reshape(high, wide, 3)[inner] = least[inner]


def plain_cover_spots(
    contrast: Bytes, threshold: int, reach: int, corner: int, spots: Bytes, doubled: Bytes, mask: Bytes
) -> None:
    """Median of the channels, threshold, dilation, and every pixel four times."""
    del doubled
    high, wide = spots.shape
    channels = contrast.reshape(high, wide, 3)[reach : high - reach, reach : wide - reach]
    first, second, third = cv2.split(channels)
    median = np.asarray(cv2.max(cv2.min(first, second), cv2.min(cv2.max(first, second), third)), np.uint8)
    for rows in (slice(0, corner), slice(max(len(median) - corner, 0), None)):
        median[rows, :corner] = 0
        median[rows, max(median.shape[1] - corner, 0) :] = 0
    _, cores = cv2.threshold(median, threshold, 255, cv2.THRESH_BINARY)
    grown = cv2.dilate(cores, np.ones((3, 3), np.uint8))
    cv2.resize(grown, mask.shape[::-1], dst=mask, interpolation=cv2.INTER_NEAREST)


GAINS = [
    Gain(contrast_with_circle, plain_contrast_with_circle),
    Gain(cover_spots, plain_cover_spots, scratch=("spots", "doubled")),
]
