"""The outline of a contact in the change of a gel's picture.

A contact is where the surface of the object lies below the surface of the untouched gel. How that looks
depends on the lighting. Light from the side responds to the slope of the surface: the middle of a ball looks
unchanged, and the change is largest in a ring around it, where the gel leaves the object, and decays farther
out (Hertz; K. L. Johnson, "Contact Mechanics", 1985, ch. 4). White light through a coating responds to the
depth of the surface: the touched area brightens or darkens as a whole, most in the middle. In both cases the
contact ends where the change has fallen to a fixed fraction of its local maximum; a global maximum would not
do, because the light is uneven. There are two such ends: the outer edge of the imprint, and farther in the
core, where the gel clings to the object.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.heights import has_two_flanks

BORDER_SLOPE_FRACTION: Final = 0.55
"""Slope at the border of a contact, as a fraction of its local maximum. Lower includes more of the
surroundings and of wrinkled gel; higher opens the ring where the light is faint. On outlines of fifteen labs,
values from 0.5 to 0.6 overlap equally well within 0.02 (`lab.judges.judge`)."""
CORE_SLOPE_FRACTION: Final = 0.8
"""The same where the gel leaves the object. Pressed by balls of known size, cores on four Minis have 0.97 to
0.99 of the radius at which the gel leaves the ball, on two DIGITs 1.04 and 1.09, and on a thick Wedge 1.27
(`lab.judges.radius`)."""
BORDER_ONE_SLOPE_FRACTION: Final = BORDER_SLOPE_FRACTION * math.sqrt(0.5)
"""Slope at the border where one component of it shows: its root mean square over all directions."""
BORDER_DEPTH_FRACTION: Final = 0.2
"""Depth at the border of a contact, as a fraction of its local maximum. Under a ball it is 0.32 on a
half-space (Johnson, ch. 4) and 0 on a thin layer; a gel lies between. 0.15 and 0.2 overlap equally well with
real outlines within 0.02."""


def change_over_maximum(shown: Floats32) -> tuple[Floats32, float]:
    """Size of the slope, or depth, of a gel over its local maximum, (h, w), and its value at the outline of a
    contact.

    shown : (k, h, w) float32, in the window of the contact, h and w even, 0 outside its region: mixtures of
        the change of the channels. Several are slopes. One is a slope if the contact brightens on one flank
        and darkens on the other, and depth if it does either as a whole.
    """
    size, border = _what_shows(shown)
    nearby = np.empty_like(size)
    largest_nearby(size, BORDER_SLOPE_FRACTION, nearby)
    return size / nearby, border


def contact_level(
    change: tuple[Floats32, float], core: Mask, border: float = BORDER_SLOPE_FRACTION
) -> Floats32:
    """Level set of one contact's outline.

    Parameters
    ----------
    change : of `change_over_maximum`, in the window of the contact.
    core : (h / n, w / n) uint8, n whole, 1 where the contact certainly is, else 0.
    border : slope at the outline as a fraction of its local maximum, in (0, 1). Where depth is shown, the
        fraction of the local depth is in proportion.

    Returns
    -------
    level : (h, w) float32, positive inside the contact, negative outside; to be interpolated.

    Examples
    --------
    A disc of radius 8 px that has brightened as a whole:

    >>> rows, columns = np.mgrid[:32, :32] - 15.5
    >>> disc = np.clip(8.5 - np.hypot(rows, columns), 0, 1).astype(np.float32)
    >>> core = (disc == 1).astype(np.uint8)
    >>> change = change_over_maximum(disc[None])
    >>> level = contact_level(change, core)
    >>> bool(abs((level > 0).sum() / np.pi - 8.4**2) < 3)
    True
    """
    values, usual = change
    level = np.empty_like(values)
    outline_level(values, min(usual * border / BORDER_SLOPE_FRACTION, 1.0), core, level)
    return level


def _what_shows(shown: Floats32) -> tuple[Floats32, float]:
    """Size of the slope, or depth, (h, w), and its fraction of the local maximum at the contact's border."""
    if len(shown) > 1:
        # OpenCV's lengths take a tenth of the time of NumPy's.
        return np.asarray(reduce(cv2.magnitude, shown), np.float32), BORDER_SLOPE_FRACTION
    (change,) = shown
    size = np.abs(change)
    if has_two_flanks(change):
        return size, BORDER_ONE_SLOPE_FRACTION
    return np.maximum(change if np.vdot(change, size) >= 0 else -change, np.float32(0)), BORDER_DEPTH_FRACTION


@kernel
def largest_nearby(values: Floats32, share: float, nearby: Floats32) -> None:
    """Local maximum, smoothed, > 0.

    The neighbourhood reaches as far as the radius of a disc with the area of the clearly changed pixels, so
    that it holds one side of the contact but not the other. There is no change beyond the window.

    values : (h, w), h and w even. share : of the maximum, from which a pixel is clearly changed. nearby :
    (h, w), filled.
    """
    smooth = np.asarray(cv2.blur(values, (3, 3)), np.float32)
    peak = max(float(smooth.max()), 1e-9)
    reach = round(math.sqrt(np.count_nonzero(values > share * peak) / math.pi) / 2)
    coarse = cv2.resize(smooth, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    padded = cv2.copyMakeBorder(coarse, reach, reach, reach, reach, cv2.BORDER_CONSTANT)
    around = cv2.blur(cv2.dilate(padded, square), square.shape, borderType=cv2.BORDER_CONSTANT)
    around = around[reach : reach + coarse.shape[0], reach : reach + coarse.shape[1]]
    # The bound only keeps quotients finite: without any, 0 / 0 where nothing has changed.
    nearby[:] = cv2.resize(np.maximum(around, np.float32(1e-3 * peak)), None, fx=2, fy=2)


@kernel
def outline_level(values: Floats32, fraction: float, core: Mask, level: Floats32) -> None:
    """Fill `level`, (h, w), as in `contact_level`; positive in components that overlap the core, which is
    part of them, with their holes filled.

    values : (h, w). fraction : of them, at the outline. core : (h / n, w / n).
    """
    sure = core.repeat(len(level) // len(core), axis=0).repeat(len(level) // len(core), axis=1)
    level[:] = values - level.dtype.type(fraction)
    changed = ((level > 0) | (sure > 0)).view(np.uint8)
    outlines, _ = cv2.findContours(changed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    filled = np.zeros(changed.shape, np.uint8)
    cv2.drawContours(filled, outlines, -1, 1.0, cv2.FILLED)
    count, components = cv2.connectedComponents(filled, connectivity=8)
    overlaps = np.zeros(count, np.bool_)
    overlaps[components[sure > 0]] = True
    inside = overlaps[components]
    # Pixels that are filled in or removed get the extreme values of the level.
    np.clip(level, -0.5, 0.5, out=level)
    np.copyto(level, inside - np.float32(0.5), where=(level > 0) != inside)


@kernel
def draw_level(level: Floats32, top: int, left: int, mask: Mask) -> None:
    """Set the pixels of a mask to 255 where a level set, interpolated to its resolution, is positive.

    level : (h, w), at half of the mask's resolution. top, left : its place in the mask, px; it may extend
    beyond the mask. mask : (H, W), 0 or 255, changed in place.

    >>> mask = np.zeros((2, 4), np.uint8)
    >>> draw_level(np.array([[1, -1]], np.float32), 0, 0, mask)
    >>> mask
    array([[255, 255,   0,   0],
           [255, 255,   0,   0]], dtype=uint8)
    """
    pixels = np.asarray(cv2.resize(level, None, fx=2, fy=2), np.float32)
    part = mask[top:, left:][: pixels.shape[0], : pixels.shape[1]]
    part[pixels[: part.shape[0], : part.shape[1]] > 0] = 255
