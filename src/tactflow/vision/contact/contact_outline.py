"""The outline of a contact in the picture of how a gel has changed.

What a gel shows depends on how it is lit. Lit by white light through a coating, a touched area brightens or
darkens as a whole: the contact ends half way between it and what surrounds it, which may have changed the
other way. Lit by coloured light from the side, the gel answers with the slope of its surface: a ball's middle
looks unchanged, and the slope is largest exactly at the border of the contact, because outside the free
surface flattens again (Hertz; K. L. Johnson, "Contact Mechanics", 1985, ch. 4). So the outline follows the
first ridge of the change from outside. The ridge itself is a poor thing to trace (it is faint where the light
comes along the border, and has gaps); its distance from the outer edge of the change is not: averaged along
the whole outline, the profile of the change across it has a clear peak. White light from one side, and a grey
picture of coloured light, show slopes as well: one flank brightens, the opposite one darkens.

Light is never even, so every change is measured by the largest one nearby (`nearby`), not in the whole
contact.

`contact_level` takes mirror images of lamps out of a window's change (`_level`), tells which of the two it
is, and has `_level_of_brightness` or `_level_of_slopes` find the level set, positive inside. Where slopes
show, what is clear beside the largest change nearby, closed by `filling`, is a region; `border` tells how far
inside the region the contact ends. Small separate parts, specks, are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.contact.border import depth_of, inside_border
from tactflow.vision.contact.components import STRAY
from tactflow.vision.contact.filling import (
    SQUARE,
    Hidden,
    Region,
    close_gaps,
    enclosed,
    fill_bay,
    is_solid,
    traced,
)
from tactflow.vision.contact.nearby import FAINT, OUTER, largest_nearby

DIM: Final = 0.5
"""Part of `OUTER` at which a change is seen in a bay of the outline, where lights hardly reach the border.
Chosen by hand; 0.33 to 0.7 give the same outlines of real gels within 0.05."""

GLOSS: Final = 1.6
"""A change of more than so many times its typical value (the mean weighted by the change itself) is a mirror
image of a lamp, and is cut to that. Chosen by hand."""

COLOURED: Final = 6.0
"""A change has brightened as a whole where its mean over the channels, squared and summed, is more than one
part in so many of its length's: of three equal channels it is one in three. Chosen by hand, half of that."""

TWO_SIDED: Final = 0.4
"""How far apart what has brightened and what has darkened are (`_sidedness`), from which on they are two
flanks of one contact: half of the 0.83 of a ball lit from one side. A dark contact with a bright halo has
0.02 (9dtact_1), other contacts that change as a whole have 0.23 at most (sts_640). In grey pictures of
mini_ball it is 0.74 to 0.83, of digit_fots 0.53 in the median."""

PLATEAU_REACH: Final = 0.7
"""Part of the contact's radius within which the largest change of a contact that has changed as a whole is
sought: its border is half as high as the plateau beside it, which darkens with its slope, not as the middle.
Chosen on handmade_dots, sts_640 and the simulator: 0.5 overlaps more there, but less on `halo`."""

FURTHEST_OUT: Final = 0.1
"""A contact that has changed as a whole ends half way, but no further out than where this fraction of the
largest change nearby is left. Chosen by hand."""


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
    >>> bool(abs((contact_level(change) > 0).sum() / np.pi - 8**2) < 3)
    True
    """
    if hidden is not None and not cv2.countNonZero(hidden):
        hidden = None
    level, near = _level(change, bridge, hidden)
    if near is not None:
        # Faint changes that only touch the contact's, such as bands of light, have pulled what is typical.
        level, _ = _level(WindowChange(change.strength * near, change.brightness * near), bridge, hidden)
    return level


def _level(change: WindowChange, bridge: float, pixels: Mask | None) -> tuple[Floats32, Floats32 | None]:
    """Level set of the outline; and, if there are specks, (h, w) float32, 1 near the contact, else 0.

    pixels : of a `Hidden`; None where nothing is hidden.
    """
    hidden, seen = None, change.strength
    if pixels is not None:
        hidden = Hidden(pixels, np.asarray(cv2.dilate(pixels, SQUARE), np.uint8))
        seen = np.where(hidden.beside > 0, np.float32(0), seen)
    cap = GLOSS * _typical(seen)
    strength = np.minimum(change.strength, np.float32(cap))
    even = cv2.norm(strength, cv2.NORM_L2SQR) / COLOURED
    # What is cut is no larger than before: where it is too little then, there is no need to cut it.
    if cv2.norm(change.brightness, cv2.NORM_L2SQR) > even:
        tone = np.float32(cap / 3**0.5)
        brightness = np.clip(change.brightness, -tone, tone)
        if cv2.norm(brightness, cv2.NORM_L2SQR) > even and _sidedness(brightness) < TWO_SIDED:
            return _without_specks(_level_of_brightness(brightness, hidden), strength), None
    return _level_of_slopes(strength, bridge, hidden)


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


def _typical(values: Floats32) -> float:
    """Mean of values >= 0, weighted by the values themselves."""
    return max(cv2.norm(values, cv2.NORM_L2SQR) / max(cv2.norm(values, cv2.NORM_L1), 1e-9), 1e-9)


def _level_of_brightness(brightness: Floats32, hidden: Hidden | None) -> Floats32:
    """Level set of a contact that has brightened or darkened as a whole, whichever is stronger."""
    brighter = np.clip(brightness, np.float32(0), np.float32(np.inf))
    darker = brighter - brightness
    if cv2.norm(darker, cv2.NORM_L2SQR) > cv2.norm(brighter, cv2.NORM_L2SQR):
        brightness, darker = -brightness, brighter
    around = _typical(darker)
    nearby = largest_nearby(brightness, PLATEAU_REACH)
    half_way = np.maximum((nearby - np.float32(around)) / 2, np.float32(FURTHEST_OUT) * nearby)
    level = (brightness - half_way) / nearby
    if hidden is not None:
        # The change is smooth here: what is painted next to what is seen is nearly right.
        pixels = np.asarray(cv2.erode(hidden.pixels, SQUARE), np.uint8)
        hidden = Hidden(pixels, np.asarray(cv2.dilate(pixels, SQUARE), np.uint8))
    inside = enclosed((level > 0).view(np.uint8), hidden).filled.view(np.bool_)
    # What is filled in is as deep inside as the middle of a plateau, what is left out as far outside.
    np.clip(level, -0.5, 0.5, out=level)
    return np.where((level > 0) == inside, level, np.where(inside, np.float32(0.5), np.float32(-0.5)))


def _level_of_slopes(
    strength: Floats32, bridge: float, hidden: Hidden | None
) -> tuple[Floats32, Floats32 | None]:
    """`_level` of a contact that shows its slopes."""
    local = strength / largest_nearby(strength)
    region, solid, specks = _sloping_region(local, strength, bridge, hidden)
    if cv2.countNonZero(region.filled) == region.filled.size:
        return np.ones_like(strength), None
    if not region.outlines:
        # All that has changed lies below markers, where it is not seen.
        return np.full_like(strength, -1), None
    inner, pixels = depth_of(region), None if hidden is None else hidden.pixels
    if specks is None:
        level = inside_border(inner, inner.depth, local, pixels)
        return level if solid else _without_specks(level, strength), None
    parts = np.where(specks, np.float32(-1), inner.depth)
    away = cv2.distanceTransform((parts <= 0).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    near = np.asarray((away < parts.max()) & ~specks, np.float32)
    return inside_border(inner, parts, local, pixels), near


def _sloping_region(
    local: Floats32, strength: Floats32, bridge: float, hidden: Hidden | None
) -> tuple[Region, bool, NDArray[np.bool_] | None]:
    """What slopes enclose; whether that is one piece without bays; and (h, w), specks in it or beside it.

    local : (h, w), the strength, relative to the largest nearby.
    """
    changed = (local > OUTER).view(np.uint8)
    region = enclosed(changed, hidden)
    if is_solid(region):
        return region, True, None
    closed = fill_bay(region, (local > DIM * OUTER).view(np.uint8))
    if closed is not region and is_solid(closed):
        return closed, True, None
    # A wrinkle or what is left of a marker is no far side of the contact, to which a gap is closed.
    left_out = _specks(closed, strength)
    kept = closed.filled if left_out is None else (closed.filled > left_out).view(np.uint8)
    ring = changed if hidden is None else changed | hidden.pixels
    ring = np.asarray(cv2.bitwise_and(ring, kept), np.uint8)
    reach = max(float(cv2.distanceTransform(ring, cv2.DIST_L2, cv2.DIST_MASK_3).max()) + 1, bridge)
    region = enclosed(close_gaps(ring, reach) | kept)
    specks = _specks(region, strength)
    if left_out is not None:
        beside = left_out & (region.filled == 0)
        specks = beside if specks is None else specks | beside
    return region, False, specks


def _specks(region: Region, strength: Floats32) -> NDArray[np.bool_] | None:
    """(h, w): separate parts of a region that hold little of the clear change; None if there are none."""
    if len(region.outlines) < 2:
        return None
    count, labels = cv2.connectedComponents(region.filled)
    clear = np.where(strength > FAINT * strength.max(), strength, np.float32(0))
    squares = np.bincount(labels.ravel(), np.square(clear).ravel(), count)
    little = squares < STRAY * squares[1:].max()
    little[0] = False
    return np.asarray(little[labels], np.bool_) if little.any() else None


def _without_specks(level: Floats32, strength: Floats32) -> Floats32:
    """The level, negative in specks, too."""
    specks = _specks(traced((level > 0).view(np.uint8)), strength)
    return level if specks is None else np.where(specks, -np.abs(level), level)
