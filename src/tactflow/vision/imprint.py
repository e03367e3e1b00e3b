"""The outline of a contact in the picture of how a gel has changed.

What a gel shows depends on how it is lit. Lit by white light through a coating, a touched area brightens as
a whole: the contact ends where half of the brightening is gone. Lit by coloured light from the side, the
gel answers with the slope of its surface: a ball's middle looks unchanged, and the slope is largest exactly
at the rim of the contact, because outside the free surface flattens again (Hertz; K. L. Johnson, "Contact
Mechanics", 1985, ch. 4). So the outline follows the ridge of the change. The ridge itself is a poor thing to
trace (it is faint where the light comes along the rim, and has gaps); its distance from the outer edge of
the change is not: averaged along the whole outline, the profile of the change across it has a clear peak.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

OUTER = 0.4
"""Fraction of its peak at which a change of slope is cut. Lower takes in more of the surroundings of a
contact and of gel that wrinkles; higher opens the ring where the light is faint."""

RIDGE = 0.9
"""The rim is where the mean profile reaches this fraction of its peak: the peak itself is flat on a knife
edge, whose flanks have the same slope all the way in."""

GLOSS = 2.0
"""A change of more than so many times its typical value (the mean weighted by the change itself) is a mirror
image of a lamp, and is cut back to that."""

SKIRT = 0.6
"""Fraction of its peak to which the mean profile has fallen in the surroundings of the contact."""

SHARP_SKIRT = 0.11
"""Distance from there to the rim where the slope breaks at the rim, as on a half-space (Hertz), in half
widths of the contact."""

BLUR = 0.6
"""What smoothing adds to that distance, pixels at half resolution."""

SOFTNESS = 1.0
"""Where the distance is larger, the gel is coated or soft and the slope has no break: the peak of the profile
is as blunt as its skirt is wide, and `RIDGE` is reached too early by this part of the excess."""

DEEPEST = 0.5
"""The rim is sought no further in than this part of the way to the middle: where the contact's own relief has
steeper slopes than its rim, the profile peaks anywhere."""

HALF = 0.45
"""Fraction of the peak at which a brightened contact ends: half of the plateau, of which noise and shading
make the peak a little more."""

SOLID = 0.96
"""Part of its convex hull that a region fills at least, if no gap is to be looked for."""

_PROFILE_STEP = 0.5
_FEW = 8
_ENOUGH = 8000
"""Pixels that are enough for the profile: of a window of n times as many, every n-th row is taken."""


def imprint(change: Float, inside: Mask, bridge: float = 4.0) -> Float:
    """Level set of one contact's outline.

    Parameters
    ----------
    change : (h, w, 3) float32, relative change of each channel, the light's own change taken out.
    inside : (h, w) uint8, not 0 where the change belongs to this contact.
    bridge : half the width of gaps that are closed in any case, px: what a removed marker can leave.

    Returns
    -------
    level : (h, w) float32, positive inside the contact, negative outside; to be interpolated. Against float64
        it differs by at most 1e-3.
    """
    sums = np.array([[1, 1, 1]], np.float32)
    mean = np.asarray(cv2.copyTo(cv2.transform(change, sums / 3), inside), np.float32)
    strength = np.asarray(cv2.sqrt(cv2.copyTo(cv2.transform(change * change, sums), inside)), np.float32)
    typical = cv2.norm(strength, cv2.NORM_L2SQR) / max(cv2.norm(strength, cv2.NORM_L1), 1e-9)
    cap = max(GLOSS * typical, 1e-9)
    np.minimum(strength, np.float32(cap), out=strength)
    sign = -1 if cv2.sumElems(mean)[0] < 0 else 1
    mean *= np.float32(sign)
    common: Float = np.minimum(mean, np.float32(cap / 3**0.5), out=mean)
    if 6 * cv2.norm(common, cv2.NORM_L2SQR) > cv2.norm(strength, cv2.NORM_L2SQR):
        return _brightened(common, _peak(common))
    return _tilted(strength, _peak(strength), bridge)


def _peak(values: Float) -> float:
    """Largest mean over 3 x 3 pixels: a maximum that noise cannot set."""
    return float(cv2.minMaxLoc(cv2.blur(values, (3, 3)))[1])


def _brightened(mean: Float, peak: float) -> Float:
    level = mean / np.float32(peak) - np.float32(HALF)
    filled = fill((level > 0).astype(np.uint8))
    level[(filled > 0) & (level <= 0)] = HALF
    return np.asarray(np.minimum(level, np.float32(HALF)) * np.float32(8), np.float32)


def _tilted(strength: Float, peak: float, bridge: float) -> Float:
    changed = (strength > OUTER * peak).astype(np.uint8)
    filled = fill(changed)
    if _solidity(filled) < SOLID:
        filled = fill(_without_gaps(changed, bridge))
    if filled.all():
        return np.ones_like(strength)
    depth = cv2.distanceTransform(filled, cv2.DIST_L2, cv2.DIST_MASK_5)
    rows = slice(None, None, max(1, filled.size // _ENOUGH))
    bins = (depth[rows] * np.float32(1 / _PROFILE_STEP)).astype(np.intp).ravel()
    count = np.bincount(bins)[1:]
    total = np.bincount(bins, weights=strength[rows].ravel())[1:]
    known = np.flatnonzero(count >= _FEW)
    if known.size < 2:
        return np.asarray(depth - np.float32(0.5), np.float32)
    profile = np.asarray(total[known] / count[known], np.float64)
    at = np.asarray((known + 1.5) * _PROFILE_STEP, np.float64)
    rim, skirt = (_crossing(profile, at, part) for part in (RIDGE, SKIRT))
    middle = float(depth.max())
    soft = rim - skirt - SHARP_SKIRT * (middle - rim) - BLUR
    return np.asarray(depth - np.float32(min(rim + SOFTNESS * max(soft, 0.0), DEEPEST * middle)), np.float32)


def _crossing(profile: NDArray[np.float64], at: NDArray[np.float64], part: float) -> float:
    """Where, coming from outside, a profile first reaches a part of its peak."""
    wanted = part * float(profile.max())
    first = int(np.argmax(profile >= wanted))
    if first == 0:
        return float(at[0])
    return float(np.interp(wanted, profile[first - 1 : first + 1], at[first - 1 : first + 1]))


def _solidity(mask: Mask) -> float:
    """Part of its convex hull that a region fills; 1 for an empty one."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        return 1.0
    around = cv2.contourArea(cv2.convexHull(np.vstack(outlines)))
    return sum(cv2.contourArea(outline) for outline in outlines) / max(around, 1.0)


def _without_gaps(mask: Mask, bridge: float) -> Mask:
    """Close gaps that are narrower than the ring itself is thick, or than a marker."""
    reach = max(float(cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_3).max()) + 1, bridge)
    margin = int(reach) + 2
    away = cv2.copyMakeBorder(1 - mask, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(1.0,))
    grown = (cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_3) <= reach).view(np.uint8)
    inner = cv2.distanceTransform(grown, cv2.DIST_L2, cv2.DIST_MASK_3)[margin:-margin, margin:-margin]
    return np.asarray(mask | (inner > reach).view(np.uint8), np.uint8)


def fill(mask: Mask) -> Mask:
    """Fill what a region encloses, alone or together with the border of the frame.

    mask : (h, w) uint8, 0 or 1. Returns the same, fresh.
    """
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    filled = np.zeros_like(mask)
    if not outlines:
        return filled
    cv2.drawContours(filled, outlines, -1, (1.0,), cv2.FILLED)
    outside, labels = cv2.connectedComponents(1 - filled, connectivity=4, ltype=cv2.CV_16U)
    if outside > 2:
        hull = np.zeros_like(mask)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.vstack(outlines)), (1.0,))
        size, covered = (
            np.ravel(cv2.calcHist([labels], [0], where, [outside], [0, outside])) for where in (None, hull)
        )
        for index in range(1, outside):
            if covered[index] > 0.8 * size[index]:
                filled[labels == index] = 1
    return filled
