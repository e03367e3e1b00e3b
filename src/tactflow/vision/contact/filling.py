"""Filling a region: holes, gaps, and pockets at the border of the frame.

A mask of what has changed becomes a `Region` by `enclosed`: `outlined` fills the holes of its parts, `traced`
finds their outlines, `fill_pockets` adds what they enclose together with the border of the frame. A region
that is not solid then (`is_solid`) may be a ring with a gap: `fill_bay` fills the largest bay where there is
a faint change, `close_gaps` bridges a gap.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Mask
from tactflow.vision.compiled import helper, kernel

BAY: Final = 2.5
"""A region with a bay that is deeper, pixels of the window, may be a ring with a gap. A gap that is
narrower than the ring is thick, or than a marker, is closed. Chosen by hand."""

POCKET: Final = 0.8
"""Part of an area between a region and the frame's border that the region's hull covers if it belongs to the
region; and of a bay that has changed, or is enclosed by what has, if the bay does. Chosen by hand."""

SQUARE: Final = np.ones((3, 3), np.uint8)
"""A pixel and its neighbours."""

PIXEL: Final = 1
PASSED: Final = 2
RIGHT: Final = 4
BESIDE: Final = 8
"""Marks of a pixel where outlines are traced: it belongs to the region; an outline passes it; one that has
what is outside to its right does; it is hidden, or next to what is."""

EIGHT_PIXELS: Final = np.uint64(0x0101010101010101)
"""`PIXEL`, of eight pixels side by side."""

ACROSS: Final = np.array([1, 1, 0, -1, -1, -1, 0, 1])
DOWN: Final = np.array([0, -1, -1, -1, 0, 1, 1, 1])
"""Steps to the eight neighbours of a pixel, counterclockwise from the right, y down."""

_GAP: Final = re.compile(b"\0+")
"""Pixels of the frame's border that do not belong to a region."""


class Hidden(NamedTuple):
    """What is not known of a mask.

    pixels : (h, w) uint8, 1 where a marker was removed, else 0. beside : 1 there and next to it, where
    smoothing has carried paint.
    """

    pixels: Mask
    beside: Mask


class Region(NamedTuple):
    """A region without holes, and its border.

    filled : (h, w) uint8, 0 or 1. outlines : of each part of it, (n, 1, 2) int32, x and y of the pixels where
    it turns, px. lengths : how many pixels each of them passes.
    """

    filled: Mask
    outlines: Sequence[NDArray[np.int32]]
    lengths: Sequence[int]


def traced(filled: Mask) -> Region:
    """The region of a mask without holes, (h, w) uint8, 0 or 1."""
    nothing = np.zeros(filled.shape, np.uint8)
    return Region(filled, *_outlines(filled, Hidden(nothing, nothing)))


def enclosed(mask: Mask, hidden: Hidden | None = None) -> Region:
    """What a mask encloses, alone or together with the border of the frame.

    mask, hidden : as for `outlined`.

    >>> import numpy as np
    >>> ring = np.ones((5, 5), np.uint8)
    >>> ring[1:4, 1:4] = 0
    >>> int(enclosed(ring).filled.sum())
    25
    """
    return fill_pockets(traced(outlined(mask, hidden)))


def outlined(mask: Mask, hidden: Hidden | None) -> Mask:
    """The parts of a region with their holes filled, fresh.

    mask : (h, w) uint8, 0 or 1. hidden : what is not known of it. There the outline runs straight from what
    is known on one side to what is known on the other.
    """
    if hidden is None:
        return _without_holes(mask.copy())
    filled = np.zeros(mask.shape, np.uint8)
    parts, _ = _outlines(mask, hidden)
    if parts:
        cv2.fillPoly(filled, parts, (1.0,))
    return filled


def _outlines(mask: Mask, hidden: Hidden) -> tuple[list[NDArray[np.int32]], list[int]]:
    """Outlines as `trace_outlines` finds them, the last one first, as OpenCV has it; and their lengths."""
    high, wide = mask.shape
    marks = np.zeros((high + 2, (wide + 9) & ~7), np.uint8)
    # A pixel is passed at most once for each of its four neighbours that is outside.
    points = np.empty((2 * (high + 1) * (wide + 1), 1, 2), np.int32)
    ends = np.empty(((high + 1) * (wide + 1) // 2, 2), np.int32)
    found = trace_outlines(mask, *hidden, marks, points, ends)
    spans, lengths = ends[found::-1].T.tolist()
    return [points[start:end] for end, start in pairwise(spans)], lengths[:-1]


@kernel("int64(uint8[:, ::1], uint8[:, ::1], uint8[:, ::1], uint8[:, ::1], int32[:, :, ::1], int32[:, ::1])")
def trace_outlines(
    mask: Mask,
    hidden: Mask,
    beside: Mask,
    marks: Mask,
    points: NDArray[np.int32],
    ends: NDArray[np.int32],
) -> int:
    """Outer borders of a region's parts, counterclockwise, as far as they are seen; returns how many.

    Border following after S. Suzuki and K. Abe, "Topological structural analysis of digitized binary images
    by border following", CVGIP 30 (1985); parts within holes are left out.

    mask : (h, w), 0 or 1. hidden, beside : of a `Hidden`; what is hidden is traced as if it belonged to the
    region, and what is beside it left out. marks : (h + 2, n), 0, changed; n a multiple of eight >= w + 2.
    points : (n, 1, 2), filled: x and y of the pixels where outlines turn or come out of what is hidden, one
    outline after another. ends : (outlines + 1, 2), filled: where the points of each outline end, and how
    many pixels it passes, after a 0.
    """
    (high, wide), eights = mask.shape, marks.view(np.uint64)
    for y in range(high):
        for x in range(wide):
            marks[y + 1, x + 1] = mask[y, x] | hidden[y, x] | beside[y, x] * BESIDE
    found = ends[0, 0] = ends[0, 1] = 0
    # Not simply 1: for a constant, numba would compile `_follow` a second time.
    first: Any = np.int64(1)
    for y in range(1, high + 1):
        x, outside = first, True
        while x <= wide:
            if marks[y, x] & PIXEL == 0:
                x += 8 if x & 7 == 0 and eights[y, x >> 3] & EIGHT_PIXELS == 0 else 1
                continue
            if outside and marks[y, x] & PASSED == 0:
                end, length = _follow(marks, x, y, points, ends[found, 0])
                if end > ends[found, 0]:
                    found += 1
                    ends[found, 0], ends[found, 1] = end, length
            while marks[y, x] & PIXEL:
                x += 8 if x & 7 == 0 and eights[y, x >> 3] & EIGHT_PIXELS == EIGHT_PIXELS else 1
            # To the right of a part lies a hole of it, or what is outside.
            outside = marks[y, x - 1] & RIGHT != 0
    return found


@helper
def _follow(marks: Mask, x: int, y: int, points: NDArray[np.int32], end: int) -> tuple[int, int]:
    """Follow one outline of `trace_outlines` from its first pixel; returns its end, and its length.

    marks : (h + 2, w + 2) uint8, changed. end : where the points before end.
    """
    back, length = 3, 0
    while back != 4 and marks[y + DOWN[back], x + ACROSS[back]] & PIXEL == 0:
        back = (back - 1) & 7
    alone, first_x, first_y, first_back = back == 4, x, y, back
    while True:
        turn = (back + 1) & 7
        while marks[y + DOWN[turn], x + ACROSS[turn]] & PIXEL == 0 and not alone:
            turn = (turn + 1) & 7
        near = marks[y + DOWN[back], x + ACROSS[back]] | marks[y + DOWN[turn], x + ACROSS[turn]]
        straight = turn == back ^ 4 and near & BESIDE == 0
        if not straight and marks[y, x] & BESIDE == 0:
            points[end, 0, 0], points[end, 0, 1] = x - 1, y - 1
            end += 1
        # What lies to the right has been looked at, and is outside.
        marks[y, x] |= PASSED | RIGHT if alone or 0 < turn <= back else PASSED
        x, y, back, length = x + ACROSS[turn], y + DOWN[turn], turn ^ 4, length + 1
        if alone or (x == first_x and y == first_y and back == first_back):
            return end, length


def _without_holes(mask: Mask) -> Mask:
    """Fill, in place, what the parts of a region enclose: half the time of filling their outlines."""
    outlines, links = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if outlines:
        for outline, parent in zip(outlines, links[0, :, 3].tolist(), strict=True):
            if parent >= 0:
                # One by one: of holes within holes, OpenCV fills every second.
                cv2.fillPoly(mask, [outline], (1.0,))
    return mask


def is_solid(region: Region) -> bool:
    """Whether a region is one piece without bays."""
    outlines = [outline for outline in region.outlines if len(outline) > 3]
    if len(outlines) != 1:
        return not outlines
    try:
        bays = cv2.convexityDefects(outlines[0], cv2.convexHull(outlines[0], returnPoints=False))
    except cv2.error:
        # OpenCV refuses an outline that touches itself, at a neck of one pixel.
        return False
    # Depths come in 256ths of a pixel.
    return bays is None or bool(max(bays.ravel()[3::4].tolist()) <= BAY * 256)


def fill_bay(region: Region, faint: Mask) -> Region:
    """Close a ring that is open on the side that lights hardly reach.

    Where a region is one piece, its largest bay is filled with what has changed faintly there, and what that
    encloses. If little of the bay is left then, it was no bay of the object.

    faint : (h, w) uint8, 0 or 1: what has changed, if only faintly. Returns the region itself if it has not
    grown.

    >>> import numpy as np
    >>> ring = np.ones((9, 9), np.uint8)
    >>> ring[3:, 3:6] = 0
    >>> faint = np.zeros_like(ring)
    >>> int(fill_bay(traced(ring), faint).filled.sum())
    63
    >>> faint[8] = 1
    >>> int(fill_bay(traced(ring), faint).filled.sum())
    81
    """
    filled, outlines, _ = region
    if len(outlines) != 1:
        return region
    bays = np.asarray(cv2.bitwise_xor(_hull(region), filled), np.uint8)
    missing = cv2.countNonZero(bays)
    grown = _without_holes(filled | (faint & bays))
    if cv2.countNonZero(grown) - cv2.countNonZero(filled) <= POCKET * missing:
        return region
    borders, _ = cv2.findContours(bays, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    bay = np.zeros_like(filled)
    cv2.drawContours(bay, [max(borders, key=cv2.contourArea)], 0, 1, cv2.FILLED)
    closed = enclosed(filled | (faint & bay))
    covered = cv2.countNonZero(np.asarray(cv2.bitwise_and(closed.filled, bay), np.uint8))
    return closed if covered > POCKET * cv2.countNonZero(bay) else region


def _hull(region: Region) -> Mask:
    """(h, w) uint8: 1 in the convex hull of a region that is not empty, else 0."""
    hull = np.zeros(region.filled.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(region.outlines)), (1.0,))
    return hull


def close_gaps(mask: Mask, reach: float) -> Mask:
    """Morphological closing of a mask, 0 or 1, by a disc with a radius of `reach` px, by distances."""
    margin = int(reach) + 2
    away = cv2.copyMakeBorder(1 - mask, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(1.0,))
    grown = (cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_3) <= reach).view(np.uint8)
    inner = cv2.distanceTransform(grown, cv2.DIST_L2, cv2.DIST_MASK_3)[margin:-margin, margin:-margin]
    return (inner > reach).view(np.uint8)


def fill_pockets(region: Region) -> Region:
    """A region with what it encloses together with the border of the frame."""
    filled = region.filled
    height, width = filled.shape
    sides = filled[0], filled[1:, -1], filled[-1, -2::-1], filled[-2:0:-1, 0]
    border = b"".join([side.tobytes() for side in sides])
    first = border.find(1)
    gaps = list(_GAP.finditer(border[first:] + border[:first])) if first >= 0 else []
    if len(gaps) < 2:
        return region
    hull, closed = _hull(region), False
    for gap in gaps:
        seed = _on_border((first + sum(gap.span()) // 2) % len(border), width, height)
        if filled[seed[1], seed[0]] or not hull[seed[1], seed[0]]:
            continue
        grown = filled.copy()
        area = cv2.floodFill(grown, None, seed, (1.0,))[0]
        covered = cv2.countNonZero(cv2.bitwise_and(cv2.bitwise_xor(grown, filled), hull))
        if covered > POCKET * area:
            filled, closed = grown, True
    return traced(filled) if closed else region


def _on_border(index: int, width: int, height: int) -> tuple[int, int]:
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
