"""The outline of a contact in the picture of how a gel has changed.

What a gel shows depends on how it is lit. Lit by white light through a coating, a touched area brightens as
a whole: the contact ends where half of the brightening is gone. Lit by coloured light from the side, the
gel answers with the slope of its surface: a ball's middle looks unchanged, and the slope is largest exactly
at the border of the contact, because outside the free surface flattens again (Hertz; K. L. Johnson, "Contact
Mechanics", 1985, ch. 4). So the outline follows the ridge of the change. The ridge itself is a poor thing to
trace (it is faint where the light comes along the border, and has gaps); its distance from the outer edge of
the change is not: averaged along the whole outline, the profile of the change across it has a clear peak.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel
from tactflow.vision.contact.filling import close_gaps, fill, fill_pockets, is_solid, outlined

Float = NDArray[np.float32]
Double = NDArray[np.float64]
Mask = NDArray[np.uint8]

OUTER: Final = 0.4
"""Fraction of its peak at which a change of slope is cut. Lower takes in more of the surroundings of a
contact and of gel that wrinkles; higher opens the ring where the light is faint. Chosen by hand."""

BORDER: Final = 0.87
"""The contact ends where the mean profile reaches this fraction of its peak: outside a contact the slope is
about 0.6 of that inside, and half way between the two, blurred, is the border of a small contact's narrow
ridge."""

TOP: Final = 0.9
"""Fraction of its peak up to which the width of the profile's skirt is measured. Chosen by hand."""

UNEVEN: Final = 1.6
"""Where the peak is more than so many times the change's typical value (the mean weighted by the change
itself), the light comes mostly from one side, and `OUTER` refers to that instead: the dim side is not cut.
Chosen by hand."""

GLOSS: Final = 2.0
"""A change of more than so many times its typical value is a mirror image of a lamp, and is cut to that.
Chosen by hand."""

EVEN: Final = 6.0
"""A change has brightened as a whole where its mean over the channels, squared and summed, is more than one
part in so many of its length's: of three equal channels it is one in three. Chosen by hand, half of that."""

SKIRT: Final = 0.6
"""Fraction of its peak to which the mean profile has fallen in the surroundings of the contact.
Chosen by hand."""

SHARP_SKIRT: Final = 0.11
"""Distance from there to the top where the slope breaks at the border, as on a half-space (Hertz), in half
widths of the contact."""

SKIRT_BLUR: Final = 0.6
"""What smoothing adds to that distance, pixels at half resolution. Chosen by hand."""

SOFTNESS: Final = 1.75
"""Where the distance is larger, the gel is coated or soft and the slope has no break: the peak of the profile
is as blunt as its skirt is wide, and `BORDER` is reached too early by so many times the excess. Chosen by
hand."""

DEEPEST: Final = 0.5
"""The border is sought no further in than this part of the way to the middle: where the contact's own relief
has steeper slopes than its border, the profile peaks anywhere. Chosen by hand."""

HALF: Final = 0.45
"""Fraction of the peak at which a brightened contact ends: half of the plateau, of which noise and shading
make the peak a little more. Chosen by hand."""

BRIGHTENED_SCALE: Final = 8.0
"""Scale of a brightened contact's level set. Chosen by hand: only its sign counts, and that of its
interpolation."""

BIN: Final = 0.5
"""Width of the profile's bins, pixels at half resolution. Chosen by hand."""

MIN_BIN_PIXELS: Final = 8
"""Pixels from which on a bin of the profile counts. Chosen by hand."""

ENOUGH_PIXELS: Final = 8000
"""Pixels that are enough for the profile: of a window with n times as many, one row in n is taken.
Chosen by hand."""

_NOTHING: Final = np.zeros((0, 0), np.uint8)
"""An empty mask."""


@dataclass(frozen=True, slots=True)
class RelativeChange:
    """How strongly a window has changed relative to its brightness, without the colour of the change.

    strength : (h, w) float32, its length over the channels. mean : (h, w) float32, its mean over them. Both 0
    where it does not belong to the contact. mean_sum : sum of `mean`. strength_sum, square_sum : sums of
    `strength` and of its squares.
    """

    strength: Float
    mean: Float
    mean_sum: float
    strength_sum: float
    square_sum: float


def contact_level(change: RelativeChange, bridge: float = 4.0, hidden: Mask | None = None) -> Float:
    """Level set of one contact's outline.

    Parameters
    ----------
    change : of the contact's window, at half resolution. Its arrays are used up.
    bridge : half the width of gaps that are closed in any case, px: what a removed marker can leave.
    hidden : (h, w) uint8, 1 where a marker was removed and the change belongs to the contact, else 0; None
        where that is not known. What was painted there smears the border outwards and leaves gaps in it; the
        outline is continued below a marker as a cubic curve from what is seen on both sides.

    Returns
    -------
    level : (h, w) float32, positive inside the contact, negative outside; to be interpolated. Against float64
        it differs by at most 1e-3.

    Examples
    --------
    A disc that has brightened as a whole, of radius 8 px:

    >>> import numpy as np
    >>> rows, columns = np.mgrid[:32, :32] - 15.5
    >>> mean = np.clip(8.5 - np.hypot(rows, columns), 0, 1).astype(np.float32)
    >>> strength = mean * np.float32(3**0.5)
    >>> change = RelativeChange(strength, mean, mean.sum(), strength.sum(), (strength**2).sum())
    >>> bool(abs((contact_level(change) > 0).sum() / np.pi - 8**2) < 3)
    True
    """
    strength, mean = change.strength, change.mean
    typical = change.square_sum / max(change.strength_sum, 1e-9)
    cap = max(GLOSS * typical, 1e-9)
    np.minimum(strength, np.float32(cap), out=strength)
    if change.mean_sum < 0:
        np.negative(mean, out=mean)
    np.minimum(mean, np.float32(cap / 3**0.5), out=mean)
    if hidden is not None and not cv2.countNonZero(hidden):
        hidden = None
    if EVEN * cv2.norm(mean, cv2.NORM_L2SQR) > cv2.norm(strength, cv2.NORM_L2SQR):
        return _brightened(mean, hidden)
    return _tilted(strength, min(_peak(strength), UNEVEN * typical), bridge, hidden)


def _peak(values: Float) -> float:
    """Largest mean over 3 x 3 pixels: a maximum that noise cannot set."""
    return float(cv2.minMaxLoc(cv2.blur(values, (3, 3)))[1])


def _brightened(mean: Float, hidden: Mask | None) -> Float:
    """Level set of a contact that has brightened as a whole."""
    level = mean * np.float32(1 / _peak(mean)) - np.float32(HALF)
    if hidden is not None:
        # The change is smooth here: what is painted next to what is seen is nearly right.
        hidden = np.asarray(cv2.erode(hidden, np.ones((3, 3), np.uint8)), np.uint8)
    filled = fill_pockets(*outlined((level > 0).view(np.uint8), hidden))
    agree_with_region(level, filled)
    return level


def _tilted(strength: Float, peak: float, bridge: float, hidden: Mask | None) -> Float:
    """Level set of a contact that shows its slopes. peak : of the strength, that of a typical side."""
    changed = (strength > OUTER * peak).view(np.uint8)
    filled, outlines = outlined(changed, hidden)
    filled = fill_pockets(filled, outlines)
    if not is_solid(filled):
        ring = changed if hidden is None else np.asarray(cv2.bitwise_and(changed | hidden, filled), np.uint8)
        reach = max(float(cv2.distanceTransform(ring, cv2.DIST_L2, cv2.DIST_MASK_3).max()) + 1, bridge)
        filled = fill(close_gaps(ring, reach) | filled)
    if cv2.countNonZero(filled) == filled.size:
        return np.ones_like(strength)
    depth = np.asarray(cv2.distanceTransform(filled, cv2.DIST_L2, cv2.DIST_MASK_5), np.float32)
    return np.asarray(depth - np.float32(_border_depth(depth, strength, hidden)), np.float32)


def _border_depth(depth: Float, strength: Float, hidden: Mask | None) -> float:
    """How far inside the outer edge of the change the contact ends, pixels at half resolution.

    depth : (h, w), distance from the outer edge, 0 outside. strength, hidden : as for `contact_level`.
    """
    every = max(1, depth.size // ENOUGH_PIXELS)
    size = int((depth.shape[0] + depth.shape[1]) / BIN) + 2
    count, total = np.zeros(size, np.int64), np.zeros(size)
    sum_profile(depth, strength, _NOTHING if hidden is None else hidden, every, count, total)
    known = np.flatnonzero(count >= MIN_BIN_PIXELS)
    if known.size < 2:
        return 0.5
    profile = (total[known] / count[known]).tolist()
    at = ((known + 0.5) * BIN).tolist()
    border, top, skirt = (_crossing(profile, at, part) for part in (BORDER, TOP, SKIRT))
    middle = float(depth.max())
    soft = top - skirt - SHARP_SKIRT * (middle - top) - SKIRT_BLUR
    return min(border + SOFTNESS * max(soft, 0.0), DEEPEST * middle)


def _crossing(profile: list[float], at: list[float], part: float) -> float:
    """Where, coming from outside, a profile first reaches a part of its peak."""
    wanted = part * max(profile)
    first = next(index for index, value in enumerate(profile) if value >= wanted)
    if first == 0:
        return at[0]
    fraction = (wanted - profile[first - 1]) / (profile[first] - profile[first - 1])
    return at[first - 1] + fraction * (at[first] - at[first - 1])


@kernel("void(float32[:, ::1], uint8[:, ::1])")
def agree_with_region(level: Float, filled: Mask) -> None:
    """Make `level` positive where `filled` is 1, else negative, at most `HALF`, and scale it; in place."""
    most, scale = np.float32(HALF), np.float32(BRIGHTENED_SCALE)
    for y in range(level.shape[0]):
        row, inside = level[y], filled[y]
        for x in range(level.shape[1]):
            value = row[x] if row[x] < most else most
            side = most if inside[x] != 0 else -most
            row[x] = scale * (value if (value > 0) == (inside[x] != 0) else side)


@kernel("void(float32[:, ::1], float32[:, ::1], uint8[:, ::1], int64, int64[::1], float64[::1])")
def sum_profile(
    depth: Float, strength: Float, hidden: Mask, every: int, counts: NDArray[np.int64], sums: Double
) -> None:
    """Number and sum of the strengths in bins of depth, of one row in `every`; both are added to.

    hidden : not 0 where a pixel does not count; (0, 0) if all do.
    """
    bins_per_pixel = np.float32(1 / BIN)
    for y in range(0, depth.shape[0], every):
        deep, strong = depth[y], strength[y]
        for x in range(depth.shape[1]):
            if deep[x] > 0 and (hidden.size == 0 or hidden[y, x] == 0):
                at = int(deep[x] * bins_per_pixel)
                counts[at] += 1
                sums[at] += strong[x]
