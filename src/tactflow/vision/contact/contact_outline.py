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

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.contact.contact_outline_kernels import (
    cap_change,
    continue_outline,
    halve_window,
    raise_level,
    settle_level,
    sum_profile,
)
from tactflow.vision.markers.mask import halved_mask

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

OUTER = 0.4
"""Fraction of its peak at which a change of slope is cut. Lower takes in more of the surroundings of a
contact and of gel that wrinkles; higher opens the ring where the light is faint."""

RIDGE = 0.87
"""The rim is where the mean profile reaches this fraction of its peak: outside a contact the slope is about
0.6 of that inside, and half way between the two, blurred, is the rim of a small contact's narrow ridge."""

TOP = 0.9
"""Fraction of its peak up to which the width of the profile's skirt is measured."""

UNEVEN = 1.6
"""Where the peak is more than so many times the change's typical value (the mean weighted by the change
itself), the light comes mostly from one side, and `OUTER` refers to that instead: the dim side is not cut."""

GLOSS = 2.0
"""A change of more than so many times its typical value is a mirror image of a lamp, and is cut to that."""

SKIRT = 0.6
"""Fraction of its peak to which the mean profile has fallen in the surroundings of the contact."""

SHARP_SKIRT = 0.11
"""Distance from there to the top where the slope breaks at the rim, as on a half-space (Hertz), in half
widths of the contact."""

BLUR = 0.6
"""What smoothing adds to that distance, pixels at half resolution."""

SOFTNESS = 1.75
"""Where the distance is larger, the gel is coated or soft and the slope has no break: the peak of the profile
is as blunt as its skirt is wide, and `RIDGE` is reached too early by so many times the excess."""

DEEPEST = 0.5
"""The rim is sought no further in than this part of the way to the middle: where the contact's own relief has
steeper slopes than its rim, the profile peaks anywhere."""

HALF = 0.45
"""Fraction of the peak at which a brightened contact ends: half of the plateau, of which noise and shading
make the peak a little more."""

BAY = 2.5
"""A region with a bay that is deeper, px at half resolution, may be a ring with a gap. A gap that is
narrower than the ring is thick, or than a marker, is closed."""

TURN = 0.2
"""Least cosine of the angle between an outline beside a marker and the chord below it: where the outline
turns back further, no curve is laid below the marker but the chord itself."""

TANGENT = 5
"""Points of an outline over which its direction beside a marker is measured."""

_PROFILE_STEP = 0.5
_FEW = 8
_ENOUGH = 8000
"""Pixels that are enough for the profile: of a window of n times as many, every n-th row is taken."""
_INWARD = 1 / 16
"""Part of a pixel by which a continued outline is drawn in, so that halfway is outside on every side."""
_STEPS = 24
"""Points of a continued part, more than it has pixels: lines drawn by OpenCV depend on their direction."""
_POCKET = 0.8
"""Part of an area between a region and the frame's border that the region's hull covers if it belongs."""

_NOTHING = np.zeros((0, 0), np.uint8)

Outlines = list[NDArray[np.int32]]


@dataclass(frozen=True, slots=True)
class Lengths:
    """A relative change without its colour.

    strength : (h, w) float32, its length over the channels. mean : (h, w) float32, its mean over them. Both 0
    where it does not belong to the contact. tone : sum of `mean`. total, squares : sum of `strength`, and of
    its squares.
    """

    strength: Float
    mean: Float
    tone: float
    total: float
    squares: float


def imprint(change: Float, inside: Mask, bridge: float = 4.0, hidden: Mask | None = None) -> Float:
    """Level set of one contact's outline.

    Parameters
    ----------
    change : (h, w, 3) float32, relative change of each channel, the light's own change taken out.
    inside : (h, w) uint8, not 0 where the change belongs to this contact.
    bridge : half the width of gaps that are closed in any case, px: what a removed marker can leave.
    hidden : (h, w) uint8, 1 where a marker was removed, else 0; None where that is not known. What was
        painted there smears the rim outwards and leaves gaps in it; the outline is continued below a marker
        as a cubic curve from what is seen on both sides.

    Returns
    -------
    level : (h, w) float32, positive inside the contact, negative outside; to be interpolated. Against float64
        it differs by at most 1e-3.
    """
    if hidden is not None:
        hidden = np.asarray(cv2.bitwise_and(hidden, hidden, mask=inside), np.uint8)
    return outline_level(lengths_of(change, inside), bridge, hidden)


def lengths_of(change: Float, inside: Mask) -> Lengths:
    """How strong a change is: (h, w, 3) float32, of which only what is not 0 in `inside`, (h, w), counts."""
    sums = np.array([[1, 1, 1]], np.float32)
    mean = np.asarray(cv2.copyTo(cv2.transform(change, sums / 3), inside), np.float32)
    strength = np.asarray(cv2.sqrt(cv2.copyTo(cv2.transform(change * change, sums), inside)), np.float32)
    total, squares = cv2.norm(strength, cv2.NORM_L1), cv2.norm(strength, cv2.NORM_L2SQR)
    return Lengths(strength, mean, cv2.sumElems(mean)[0], total, squares)


def outline_level(lengths: Lengths, bridge: float, hidden: Mask | None) -> Float:
    """`imprint` of a change whose strength is known; its arrays are used up. hidden : 0 outside of it."""
    strength, mean = lengths.strength, lengths.mean
    typical = lengths.squares / max(lengths.total, 1e-9)
    cap = max(GLOSS * typical, 1e-9)
    even, sign = cap / 3**0.5, -1.0 if lengths.tone < 0 else 1.0
    if compiled.active():
        sums = np.empty(2)
        cap_change(strength, mean, sign, cap, even, sums)
        squares, tones = sums.tolist()
    else:
        np.minimum(strength, np.float32(cap), out=strength)
        np.multiply(mean, np.float32(sign), out=mean)
        np.minimum(mean, np.float32(even), out=mean)
        squares, tones = cv2.norm(strength, cv2.NORM_L2SQR), cv2.norm(mean, cv2.NORM_L2SQR)
    if hidden is not None and not cv2.countNonZero(hidden):
        hidden = None
    if 6 * tones > squares:
        return _brightened(mean, _peak(mean), hidden)
    return _tilted(strength, min(_peak(strength), UNEVEN * typical), bridge, hidden)


def hidden_cells(hidden: Mask, top: int, left: int, inside: NDArray[np.bool_]) -> Mask:
    """A window of a mask at half resolution, (2 h, 2 w) uint8: 1 where any pixel is not 0 and counts, else 0.

    hidden : (H, W) uint8, over whose border the window may reach. top, left : of the window, px. inside :
    (h, w) bool, which blocks of 4 x 4 px count.
    """
    high, wide = 2 * inside.shape[0], 2 * inside.shape[1]
    if compiled.active():
        halved = np.empty((high, wide), np.uint8)
        halve_window(np.ascontiguousarray(hidden), top, left, inside.view(np.uint8), halved)
        return halved
    part = hidden[top : top + 2 * high, left : left + 2 * wide]
    below, beside = 2 * high - part.shape[0], 2 * wide - part.shape[1]
    if below or beside:
        part = np.asarray(cv2.copyMakeBorder(part, 0, below, 0, beside, cv2.BORDER_CONSTANT), np.uint8)
    counts = cv2.resize(inside.view(np.uint8), (wide, high), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.bitwise_and(halved_mask(part), counts), np.uint8)


def fill_level(level: Float, top: int, left: int, mask: Mask) -> None:
    """Set to 255 the pixels of a mask where a level set, interpolated to twice its size, is positive.

    level : (h, w) float32. top, left : its place in the mask, over whose border it may reach. mask : (H, W)
    uint8, changed in place.
    """
    if compiled.active():
        raise_level(level, top, left, mask)
        return
    window = mask[top : top + 2 * level.shape[0], left : left + 2 * level.shape[1]]
    large = cv2.resize(level, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    above = np.asarray(cv2.compare(large, np.zeros(1), cv2.CMP_GT), np.uint8)
    window |= above[: window.shape[0], : window.shape[1]]


def _peak(values: Float) -> float:
    """Largest mean over 3 x 3 pixels: a maximum that noise cannot set."""
    return float(cv2.minMaxLoc(cv2.blur(values, (3, 3)))[1])


def _brightened(mean: Float, peak: float, hidden: Mask | None) -> Float:
    level = mean * np.float32(1 / peak) - np.float32(HALF)
    if hidden is not None:
        # The change is smooth here: what is painted next to what is seen is nearly right.
        hidden = np.asarray(cv2.erode(hidden, np.ones((3, 3), np.uint8)), np.uint8)
    above = (level > 0).view(np.uint8)
    filled = _pockets(*_outlined(above, hidden))
    if compiled.active():
        settle_level(level, filled, HALF, 8)
        return level
    sides = np.where(filled, np.float32(HALF), np.float32(-HALF))
    level = np.where(above == filled, np.minimum(level, np.float32(HALF)), sides)
    return np.asarray(level * np.float32(8), np.float32)


def _tilted(strength: Float, peak: float, bridge: float, hidden: Mask | None) -> Float:
    changed = (strength > OUTER * peak).view(np.uint8)
    filled, outlines = _outlined(changed, hidden)
    filled = _pockets(filled, outlines)
    if not _solid(filled):
        ring = changed if hidden is None else np.asarray(cv2.bitwise_and(changed | hidden, filled), np.uint8)
        reach = max(float(cv2.distanceTransform(ring, cv2.DIST_L2, cv2.DIST_MASK_3).max()) + 1, bridge)
        filled = fill(_closed(ring, reach) | filled)
    if cv2.countNonZero(filled) == filled.size:
        return np.ones_like(strength)
    depth = np.asarray(cv2.distanceTransform(filled, cv2.DIST_L2, cv2.DIST_MASK_5), np.float32)
    count, total = _profile(depth, strength, hidden)
    known = np.flatnonzero(count >= _FEW)
    if known.size < 2:
        return np.asarray(depth - np.float32(0.5), np.float32)
    profile = (total[known] / count[known]).tolist()
    at = ((known + 1.5) * _PROFILE_STEP).tolist()
    rim, top, skirt = (_crossing(profile, at, part) for part in (RIDGE, TOP, SKIRT))
    middle = float(depth.max())
    soft = top - skirt - SHARP_SKIRT * (middle - top) - BLUR
    return np.asarray(depth - np.float32(min(rim + SOFTNESS * max(soft, 0.0), DEEPEST * middle)), np.float32)


def _profile(
    depth: Float, strength: Float, hidden: Mask | None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Number and sum of the strengths in bins of depth, from the second bin on."""
    every = max(1, depth.size // _ENOUGH)
    if compiled.active():
        size = int((depth.shape[0] + depth.shape[1]) / _PROFILE_STEP) + 2
        count, total = np.zeros(size, np.int64), np.zeros(size)
        covered = _NOTHING if hidden is None else hidden
        sum_profile(depth, strength, covered, every, 1 / _PROFILE_STEP, count, total)
        return count[1:], total[1:]
    rows = slice(None, None, every)
    seen = depth[rows]
    if hidden is not None:
        seen = np.asarray(cv2.copyTo(seen, 1 - hidden[rows]), np.float32)
    flat = seen.ravel()
    within = np.flatnonzero(flat)
    bins = (flat[within] * np.float32(1 / _PROFILE_STEP)).astype(np.intp)
    numbers, sums = np.bincount(bins), np.bincount(bins, weights=strength[rows].ravel()[within])
    return np.asarray(numbers[1:], np.int64), np.asarray(sums[1:], np.float64)


def _crossing(profile: list[float], at: list[float], part: float) -> float:
    """Where, coming from outside, a profile first reaches a part of its peak."""
    wanted = part * max(profile)
    first = next(index for index, value in enumerate(profile) if value >= wanted)
    if first == 0:
        return at[0]
    share = (wanted - profile[first - 1]) / (profile[first] - profile[first - 1])
    return at[first - 1] + share * (at[first] - at[first - 1])


def _outlined(mask: Mask, hidden: Mask | None) -> tuple[Mask, Outlines]:
    """The parts of a region with their holes filled, and their outlines.

    mask : (h, w) uint8, 0 or 1. hidden : the same: what is not known of the mask.
    """
    known = mask if hidden is None else np.asarray(cv2.bitwise_or(mask, hidden), np.uint8)
    found, _ = cv2.findContours(known, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if hidden is None:
        outlines = [np.asarray(outline[:, 0], np.int32) for outline in found]
    else:
        # Smoothing has carried what was painted one pixel further.
        grown = np.asarray(cv2.dilate(hidden, np.ones((3, 3), np.uint8)), np.uint8)
        outlines = [
            outline
            for outline in (_continued(np.asarray(outline[:, 0]), grown) for outline in found)
            if outline is not None
        ]
    filled = np.zeros_like(mask)
    if outlines:
        cv2.fillPoly(filled, outlines, (1.0,))
    return filled, outlines


def _continued(outline: NDArray[np.int32], hidden: Mask) -> NDArray[np.int32] | None:
    """An outline, (n, 2) px, its hidden parts replaced by cubics; None if all is hidden.

    Between the last point before a marker and the first behind it runs the cubic that has the outline's
    direction at both (Hermite); where the outline turns back, which no cubic should guess, a straight line.
    """
    if compiled.active():
        line = np.empty((len(outline) + len(outline) // 2 * len(_CUBICS), 2), np.int32)
        count = continue_outline(outline, hidden, _CUBICS, _INWARD, TANGENT, TURN, line)
        return outline if count < 0 else line[:count] if count else None
    below = hidden[outline[:, 1], outline[:, 0]] > 0
    unseen = np.count_nonzero(below)
    if unseen == 0:
        return outline
    if unseen == len(below):
        return None
    # Begin behind a hidden part, so that no seen part is cut in two.
    start = int(np.argmax(below < np.roll(below, 1)))
    below = np.concatenate([below[start:], below[:start], below[start : start + 1]])
    points = np.concatenate([outline[start:], outline[:start]]).astype(np.float64)
    count = len(points)
    # The first point is seen, so a change is in turn the first hidden one of a part and the first behind it.
    change = np.flatnonzero(below[1:] != below[:-1]) + 1
    first, behind = change[::2], change[1::2]
    since = np.maximum(first - 1 - TANGENT, np.concatenate([[0], behind[:-1]]))
    until = np.minimum(behind + TANGENT, np.concatenate([first[1:], [count + first[0]]]) - 1)
    before, after = points[first - 1], points[behind % count]
    chord = after - before
    square = np.einsum("ij,ij->i", chord, chord)
    # Directions at both ends, as long as the chord, and the cosines of their angles to it.
    ways = np.stack([before - points[since], points[until % count] - after])
    ways *= np.sqrt(square / np.maximum(np.einsum("kij,kij->ki", ways, ways), 1e-9))[..., None]
    along = np.einsum("kij,ij->ki", ways, chord) / np.maximum(square, 1e-9)
    ahead = along.min(axis=0) > TURN
    # With tangents of this length, equal angles at both ends make a curve as high as the circle's arc.
    ways *= (4 / np.maximum(2 + along.sum(axis=0), 1))[:, None]
    ways[:, ~ahead] = chord[~ahead]
    curves = _CUBICS @ np.stack([before, ways[0], after, ways[1]], axis=1)
    inwards = chord[:, ::-1] * (_INWARD, -_INWARD) / np.sqrt(np.maximum(square, 1))[:, None]
    curves += inwards[:, None]
    pieces, last = [], 0
    for curve, left, back in zip(curves, first.tolist(), behind.tolist(), strict=True):
        pieces += [points[last:left], curve]
        last = back
    pieces.append(points[last:])
    return np.asarray(np.rint(np.concatenate(pieces)), np.int32)


def _cubics(steps: int) -> NDArray[np.float64]:
    """(steps - 1, 4): Hermite's cubics between start and end, both left out."""
    t = np.arange(1, steps) / steps
    back = 1 - t
    return np.stack([(1 + 2 * t) * back**2, t * back**2, t**2 * (3 - 2 * t), -(t**2) * back], axis=1)


_CUBICS = _cubics(_STEPS)


def _solid(filled: Mask) -> bool:
    """Whether a region, (h, w) uint8, 0 or 1, is one piece without bays."""
    outlines, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outlines = [outline for outline in outlines if len(outline) > 3]
    if len(outlines) != 1:
        return not outlines
    try:
        bays = cv2.convexityDefects(outlines[0], cv2.convexHull(outlines[0], returnPoints=False))
    except cv2.error:
        # OpenCV refuses an outline that touches itself, at a neck of one pixel.
        return False
    # Depths come in 256ths of a pixel.
    return bays is None or bool(bays.reshape(-1, 4)[:, 3].max() <= BAY * 256)


def _closed(mask: Mask, reach: float) -> Mask:
    """Morphological closing of a mask, 0 or 1, by a disc with a radius of `reach` px, by distances."""
    margin = int(reach) + 2
    away = cv2.copyMakeBorder(1 - mask, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(1.0,))
    grown = (cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_3) <= reach).view(np.uint8)
    inner = cv2.distanceTransform(grown, cv2.DIST_L2, cv2.DIST_MASK_3)[margin:-margin, margin:-margin]
    return (inner > reach).view(np.uint8)


def _pockets(filled: Mask, outlines: Outlines) -> Mask:
    """Fill, perhaps in place, what a region encloses together with the border of the frame."""
    rim = np.concatenate([filled[0], filled[1:, -1], filled[-1, -2::-1], filled[-2:0:-1, 0]])
    before = np.concatenate([rim[-1:], rim[:-1]])
    starts = np.flatnonzero(rim < before).tolist()
    if len(starts) < 2:
        return filled
    ends = np.flatnonzero(rim > before).tolist()
    if ends[0] < starts[0]:
        ends = [*ends[1:], ends[0] + len(rim)]
    height, width = filled.shape
    hull = np.zeros_like(filled)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outlines)), (1.0,))
    closed = False
    for start, end in zip(starts, ends, strict=True):
        seed = _on_rim((start + end) // 2 % len(rim), width, height)
        if filled[seed[1], seed[0]] or not hull[seed[1], seed[0]]:
            continue
        other = filled.copy()
        area, *_ = cv2.floodFill(other, None, seed, (2.0,))
        pocket = (other == 2).view(np.uint8)
        if cv2.countNonZero(cv2.bitwise_and(pocket, hull)) > _POCKET * area:
            filled |= pocket
            closed = True
    # What was open to both sides of a pocket is now a hole.
    return _outlined(filled, None)[0] if closed else filled


def _on_rim(index: int, width: int, height: int) -> tuple[int, int]:
    """(x, y) of a pixel on the border, counted clockwise from the top left corner."""
    if index < width:
        return index, 0
    index -= width - 1
    if index < height:
        return width - 1, index
    index -= height - 1
    if index < width:
        return width - 1 - index, height - 1
    return 0, height - 1 - (index - width + 1)


def fill(mask: Mask) -> Mask:
    """Fill what a region encloses, alone or together with the border of the frame.

    mask : (h, w) uint8, 0 or 1. Returns the same, fresh.
    """
    return _pockets(*_outlined(mask, None))
