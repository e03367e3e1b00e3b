"""The outline of a contact in the picture of how a gel has changed.

A contact is where the surface of the object lies below the surface of the untouched gel. What shows of that
depends on how the gel is lit. Coloured light from the side, or any light from one side, answers with the
slope of the surface: a ball's middle looks unchanged, and the change is largest in a ring around it, where
the gel leaves the object, and falls off further out (Hertz; K. L. Johnson, "Contact Mechanics", 1985, ch. 4).
White light through a coating answers with the depth of the surface: the touched area brightens or darkens as
a whole, most in the middle. In both cases the contact ends where the change has fallen to a certain part of
the largest one nearby: light is never even, so what is far away is no measure.

`contact_level` tells which of the two it is, and finds that level set, positive inside. What the clear change
encloses belongs to it, also through gaps (`filling`); small separate parts, specks, are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.contact.components import STRAY
from tactflow.vision.contact.filling import Hidden, Region, close_gaps, enclosed, is_solid
from tactflow.vision.contact.nearby import FAINT, OUTER, largest_nearby

SHALLOW: Final = 0.15
"""Part of the largest depth nearby that the gel has at the border of a contact. Under a ball it is 0.32 on a
half-space (Johnson, ch. 4) and 0 on a thin layer; a gel lies between. 0.1 to 0.2 overlap as well with real
outlines within 0.02."""

COLOURED: Final = 6.0
"""A change has brightened as a whole where its mean over the channels, squared and summed, is more than one
part in so many of its length's: of three equal channels it is one in three. Chosen by hand, half of that."""

TWO_SIDED: Final = 0.4
"""How far apart what has brightened and what has darkened are (`_sidedness`), from which on they are two
flanks of one contact: half of the 0.83 of a ball lit from one side. A dark contact with a bright halo has
0.02 (9dtact_1), other contacts that change as a whole have 0.23 at most (sts_640). In grey pictures of
mini_ball it is 0.74 to 0.83, of digit_fots 0.53 in the median."""


@dataclass(frozen=True, slots=True)
class WindowChange:
    """How strongly a window has changed, in standard deviations, without the colour of the change.

    strength : (h, w) float32, its length over the channels. brightness : (h, w) float32, its mean over them.
    Both 0 where it does not belong to the contact.
    """

    strength: Floats32
    brightness: Floats32


def contact_level(change: WindowChange, bridge: float = 4.0, hidden: Mask | None = None) -> Floats32:
    """Level set of one contact's outline.

    Parameters
    ----------
    change : of the contact's window, at half resolution or pixel by pixel.
    bridge : half the width of gaps that are closed in any case, px: what a removed marker can leave.
    hidden : (h, w) uint8, 1 where a marker was removed and the change belongs to the contact, else 0; None
        where that is not known. What was painted there smears the border outwards and leaves gaps in it; the
        outline runs straight below a marker, from what is seen on one side to what is seen on the other.

    Returns
    -------
    level : (h, w) float32, positive inside the contact, negative outside; to be interpolated. Against float64
        it differs by at most 1e-3.

    Examples
    --------
    A disc that has brightened as a whole, of radius 8 px:

    >>> import numpy as np
    >>> rows, columns = np.mgrid[:32, :32] - 15.5
    >>> brightness = np.clip(8.5 - np.hypot(rows, columns), 0, 1).astype(np.float32)
    >>> change = WindowChange(brightness * np.float32(3**0.5), brightness)
    >>> bool(abs((contact_level(change) > 0).sum() / np.pi - 8.4**2) < 3)
    True
    """
    shows, border = _what_shows(change)
    level = shows / largest_nearby(shows) - np.float32(border)
    covered = None
    if hidden is not None and cv2.countNonZero(hidden):
        covered = Hidden.of(hidden)
    inside = _region((level > 0).view(np.uint8), shows, bridge, covered)
    # What is filled in is as deep inside as what has changed most, what is left out as far outside.
    np.clip(level, -0.5, 0.5, out=level)
    return np.where((level > 0) == inside, level, np.where(inside, np.float32(0.5), np.float32(-0.5)))


def _what_shows(change: WindowChange) -> tuple[Floats32, float]:
    """What tells of the contact, (h, w), and the part of its largest value at which the contact ends."""
    brightness = change.brightness
    whole = cv2.norm(change.strength, cv2.NORM_L2SQR)
    if COLOURED * cv2.norm(brightness, cv2.NORM_L2SQR) <= whole or _sidedness(brightness) >= TWO_SIDED:
        return change.strength, OUTER
    brighter = np.clip(brightness, np.float32(0), np.float32(np.inf))
    darker = brighter - brightness
    if cv2.norm(darker, cv2.NORM_L2SQR) > cv2.norm(brighter, cv2.NORM_L2SQR):
        return darker, SHALLOW
    return brighter, SHALLOW


def _sidedness(brightness: Floats32) -> float:
    """How far apart what has brightened and what has darkened are, 0..1.

    The distance of the centroids of both, weighted by the squared change, times twice the product of their
    shares, over the radius of gyration of the whole: 0 where all has changed the same way, or where one way
    lies around the other; 0.83 for a disc whose change grows linearly from one side to the other.
    """
    squares = np.square(brightness)
    whole = cv2.moments(squares)
    brighter = cv2.moments(np.where(brightness > 0, squares, np.float32(0)))
    share = brighter["m00"] / max(whole["m00"], 1e-9)
    if not 0 < share < 1:
        return 0.0
    # The brighter part is as far from the whole as from the darker part, times the darker part's share.
    apart = [brighter[key] / brighter["m00"] - whole[key] / whole["m00"] for key in ("m10", "m01")]
    # Of a single pixel it is 0, or by rounding less.
    gyration = math.sqrt(max((whole["mu20"] + whole["mu02"]) / whole["m00"], 1e-18))
    return 2 * share * math.hypot(*apart) / gyration


def _region(changed: Mask, shows: Floats32, bridge: float, hidden: Hidden | None) -> NDArray[np.bool_]:
    """(h, w): what a clear change encloses.

    changed : (h, w) uint8, 1 where it is clear, else 0. shows : (h, w), the change.
    """
    region = enclosed(changed, hidden)
    if is_solid(region):
        return region.filled.view(np.bool_)
    # A wrinkle or what is left of a marker is no far side of the contact, to which a gap is closed.
    kept = _without_specks(region, shows)
    ring = changed if hidden is None else changed | hidden.pixels
    ring = np.asarray(cv2.bitwise_and(ring, kept), np.uint8)
    reach = max(float(cv2.distanceTransform(ring, cv2.DIST_L2, cv2.DIST_MASK_3).max()) + 1, bridge)
    return _without_specks(enclosed(close_gaps(ring, reach) | kept), shows).view(np.bool_)


def _without_specks(region: Region, shows: Floats32) -> Mask:
    """(h, w) uint8: a region without separate parts that hold little of the clear change."""
    if len(region.outlines) < 2:
        return region.filled
    count, labels = cv2.connectedComponents(region.filled)
    clear = np.where(shows > FAINT * shows.max(), shows, np.float32(0))
    squares = np.bincount(labels.ravel(), np.square(clear).ravel(), count)
    kept = squares >= STRAY * squares[1:].max()
    kept[0] = False
    return np.asarray(kept[labels], np.uint8)
