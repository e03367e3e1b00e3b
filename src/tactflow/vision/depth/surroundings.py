"""Where the gel may have sunk: the part of a picture that a height map is computed for."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.depth.slopes import BAND, Bytes
from tactflow.vision.geometry.region import measure_region

MARGIN: Final = 1.25
"""How far the gel may have sunk beyond the contact, relative to half of the contact's shorter axis. Chosen on
the simulator: with 0.8 `finger` has errors of 2.6 % under `photometric` instead of 0.7."""
LEAST_MARGIN: Final = 12
"""The same at least, pixels at half resolution; a calibration looks no farther. With 8, errors under `mixed`
are two to seven times as large; with 14, those of a box there are 5.4 % instead of 4.2."""


class Window(NamedTuple):
    """Part of a picture at half resolution, px."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def height(self) -> int:
        """Rows."""
        return self.bottom - self.top

    @property
    def width(self) -> int:
        """Columns."""
        return self.right - self.left

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns at half resolution."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def whole(self) -> tuple[slice, slice]:
        """Rows and columns at full resolution."""
        return slice(2 * self.top, 2 * self.bottom), slice(2 * self.left, 2 * self.right)


class Surroundings(NamedTuple):
    """Where the gel may have sunk: a window, and what of it is near the contact, as `SlopeModel.slopes` takes
    it. Elsewhere the gel is at rest."""

    window: Window
    near: Bytes


def surroundings(mask: Bytes, whole: Window, relative: float = MARGIN) -> Surroundings:
    """Around the contact of a mask (H, W) uint8, 255 in contact; not all 0.

    relative : how far, in halves of the contact's shorter axis; `LEAST_MARGIN` at least.
    """
    contact = measure_region(mask)
    x, y, width, height = contact[:4]
    margin = max(LEAST_MARGIN, round(relative * math.sqrt(contact.moments().principal[1])))
    left, right = max(0, x // 2 - margin), min((x + width + 1) // 2 + margin, whole.right)
    # Rows of such a length are transformed in a third of the time.
    columns = min(cv2.getOptimalDFTSize(right - left), whole.right)
    left = min(left, whole.right - columns)
    top, bottom = max(0, y // 2 - margin), min((y + height + 1) // 2 + margin, whole.bottom)
    window = Window(top, bottom, left, left + columns)
    return Surroundings(window, _near(mask, window, margin))


def _near(mask: Bytes, window: Window, margin: int) -> Bytes:
    """(bands, w): what of a window is near the contact, in bands of `BAND` rows; not 0 there."""
    bands = -(-window.height // BAND)
    contact = np.zeros((bands * BAND, window.width), np.uint8)
    size = (window.width, window.height)
    cv2.resize(mask[window.whole], size, contact[: window.height], interpolation=cv2.INTER_AREA)
    reach = np.ones((2 * -(-margin // BAND) + 1, 2 * margin + 1), np.uint8)
    return np.asarray(cv2.dilate(contact.reshape(bands, BAND, -1).max(axis=1), reach), np.uint8)
