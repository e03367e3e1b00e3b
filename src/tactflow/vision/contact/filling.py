"""Filling a region: holes, gaps, and pockets at the border of the frame.

A mask of what has changed becomes a `Region` by `enclosed`: `outlined` fills the holes of its parts, `traced`
finds their outlines, `fill_pockets` adds what they enclose together with the border of the frame. A region
that is not solid then (`is_solid`) may be a ring with a gap, which `close_gaps` bridges.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Mask

BAY: Final = 2.5
"""A region with a bay that is deeper, pixels of the window, may be a ring with a gap. A gap that is
narrower than the ring is thick, or than a marker, is closed. Chosen by hand."""

POCKET: Final = 0.8
"""Part of an area between a region and the frame's border that the region's hull covers if it belongs to the
region. Chosen by hand."""

SQUARE: Final = np.ones((3, 3), np.uint8)
"""A pixel and its neighbours."""

_GAP: Final = re.compile(b"\0+")
"""Pixels of the frame's border that do not belong to a region."""


class Hidden(NamedTuple):
    """What is not known of a mask.

    pixels : (h, w) uint8, 1 where a marker was removed, else 0. beside : 1 there and next to it, where
    smoothing has carried paint.
    """

    pixels: Mask
    beside: Mask

    @classmethod
    def of(cls, pixels: Mask) -> Hidden:
        """From the pixels alone."""
        return cls(pixels, np.asarray(cv2.dilate(pixels, SQUARE), np.uint8))


class Region(NamedTuple):
    """A region without holes, and its border.

    filled : (h, w) uint8, 0 or 1. outlines : of each part of it, (n, 1, 2) int32, x and y of the pixels where
    it turns, px.
    """

    filled: Mask
    outlines: Sequence[NDArray[np.int32]]


def traced(filled: Mask) -> Region:
    """The region of a mask without holes, (h, w) uint8, 0 or 1."""
    outlines, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return Region(filled, [np.asarray(outline, np.int32) for outline in outlines])


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
    outlines, _ = cv2.findContours(mask | hidden.pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    seen = [outline[hidden.beside[outline[:, 0, 1], outline[:, 0, 0]] == 0] for outline in outlines]
    filled = np.zeros(mask.shape, np.uint8)
    for outline in seen:
        if len(outline):
            cv2.fillPoly(filled, [outline], (1.0,))
    return filled


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
