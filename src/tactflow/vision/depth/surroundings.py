"""Where the gel may have sunk: the part of a picture that a height map is computed for."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes, Floats, Floats32
from tactflow.vision.compiled import kernel
from tactflow.vision.depth.slopes import BAND_ROWS
from tactflow.vision.geometry.region import measure_region

MIN_MARGIN_PX: Final = 12
"""Smallest margin around the contact in which the gel may have sunk, pixels at half resolution; that of a
calibration. With 8, errors under `mixed` are two to seven times as large."""
CELL_PX: Final = 8
"""Side of the cells in which the gel at rest is searched for, px of the picture."""
REST_CHANGE_RATIO: Final = 0.05
"""Change of the light at which the gel counts as at rest, over that at the rim of the contact, both less that
far away: what lies beyond adds a hundredth to the depth."""
MIN_LIT_LEVEL: Final = 0.5
"""Least `level` of a cell that shows how much the light has changed: its light at rest is then at least
`LIGHT_OFFSET_GREY` of `surface`, so that grey levels of noise are a small part of it."""
MIN_GAIN: Final = 0.1
"""Smallest gain that is divided by: a picture that is darker shows no gel."""


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

    def open_sides(self, whole: Window) -> tuple[tuple[bool, bool], tuple[bool, bool]]:
        """Whether the picture `whole` cuts off its left and right, and its top and bottom."""
        across = self.left == whole.left, self.right == whole.right
        return across, (self.top == whole.top, self.bottom == whole.bottom)

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns at half resolution."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def whole(self) -> tuple[slice, slice]:
        """Rows and columns at full resolution."""
        return slice(2 * self.top, 2 * self.bottom), slice(2 * self.left, 2 * self.right)


class Surroundings(NamedTuple):
    """Where the gel may have sunk: a window, and its part near the contact, in the form of
    `SlopeModel.slopes`. Elsewhere the gel is at rest."""

    window: Window
    near: Bytes


def surroundings(mask: Bytes, whole: Window, margin: int = MIN_MARGIN_PX) -> Surroundings:
    """Around the contact of a mask (H, W) uint8, 255 in contact; not all 0.

    margin : how far from the contact, pixels at half resolution.
    """
    x, y, width, height = measure_region(mask)[:4]
    left, right = max(0, x // 2 - margin), min((x + width + 1) // 2 + margin, whole.right)
    # Rows of such a length are transformed in a third of the time.
    columns = min(cv2.getOptimalDFTSize(right - left), whole.right)
    left = min(left, whole.right - columns)
    top, bottom = max(0, y // 2 - margin), min((y + height + 1) // 2 + margin, whole.bottom)
    window = Window(top, bottom, left, left + columns)
    return Surroundings(window, _near(mask, window, margin))


class Resting(NamedTuple):
    """Where the gel around a contact is at rest.

    Attributes
    ----------
    margin : distance from the contact, pixels at half resolution.
    gain : (3,) float32, the light there, over the light of the untouched gel.
    """

    margin: int
    gain: Floats32


def resting(change: Floats32, level: Floats32, mask: Bytes) -> Resting:
    """Find the distance from a contact beyond which the gel is at rest, and how its light has changed there.

    The change of the light decreases with the distance from the contact: the gel is at rest from the first
    ring around it in which the mean change has faded (`REST_CHANGE_RATIO`). Exposure and white balance
    multiply a channel by a factor all over the picture, which the gel far from the contact shows.

    change : (h, w, 3) float32, relative change of the light in cells of `CELL_PX` x `CELL_PX` pixels. level :
    (h, w, 3) float32, by how much `change` grows if the light doubles. mask : (H, W) uint8, 255 in contact;
    not all 0.
    """
    height, width = change.shape[:2]
    middle = CELL_PX // 2
    contact = mask[middle : height * CELL_PX : CELL_PX, middle : width * CELL_PX : CELL_PX]
    if contact.all() or not contact.any():
        return Resting(MIN_MARGIN_PX, np.ones(3, np.float32))
    distance = np.asarray(cv2.distanceTransform((contact == 0).view(np.uint8), cv2.DIST_L2, 5), np.float32)
    last = int(distance.max())
    growth, rings = np.empty(3, np.float32), np.zeros((2, last + 1))
    nearest = min(2 * MIN_MARGIN_PX // CELL_PX, last)
    light_around(change, level, distance, nearest, MIN_LIT_LEVEL, growth, rings)
    profile = rings[0, 1:] / np.maximum(rings[1, 1:], 1)
    far = float(profile.min())
    faded = np.flatnonzero(profile <= far + REST_CHANGE_RATIO * (profile[0] - far))
    return Resting(max(MIN_MARGIN_PX, (int(faded[0]) + 1) * CELL_PX // 2), 1 + growth)


@kernel
def light_around(
    change: Floats32,
    level: Floats32,
    distance: Floats32,
    nearest: float,
    least: float,
    growth: Floats32,
    rings: Floats,
) -> None:
    """How the light has changed at each distance from a contact, less what has changed far from it.

    change, level : see `resting`. distance : (h, w), cells, from the contact. nearest : of the gel at rest.
    least : `MIN_LIT_LEVEL`.
    growth : (3,), filled: by which part of itself each channel has grown, the upper median of the gel at
        rest. Dark cells show noise instead; without others, nothing has grown.
    rings : (2, n) of 0, to which are added: change of the light in each ring of cells, and their number.
    """
    for channel in range(3):
        lit = (distance >= nearest) & (level[..., channel] >= least)
        ratios = change[lit, channel] / level[lit, channel]
        growth[channel] = np.sort(ratios)[ratios.size // 2] if ratios.size else 0
    strength = np.sqrt(((change - growth * level) ** 2).sum(axis=2))
    ring, count = distance.astype(np.intp).ravel(), rings.shape[1]
    rings += np.bincount(ring, strength.ravel(), count), np.bincount(ring, minlength=count)


def _near(mask: Bytes, window: Window, margin: int) -> Bytes:
    """(bands, w): the part of a window near the contact, in bands of `BAND_ROWS` rows; not 0 there."""
    bands = -(-window.height // BAND_ROWS)
    contact = np.zeros((bands * BAND_ROWS, window.width), np.uint8)
    size = (window.width, window.height)
    cv2.resize(mask[window.whole], size, contact[: window.height], interpolation=cv2.INTER_AREA)
    reach = np.ones((2 * -(-margin // BAND_ROWS) + 1, 2 * margin + 1), np.uint8)
    return np.asarray(cv2.dilate(contact.reshape(bands, BAND_ROWS, -1).max(axis=1), reach), np.uint8)
