"""Contacts as level lines of the shape of a gel.

Around an object the gel climbs from rest to the object, so the mean slope along a level line is largest where
it leaves the object. The salience of a line is its mean slope in standard errors, which shrink with the
square root of its length: a long line is less likely to be steep by chance (A. Desolneux, L. Moisan, J.-M.
Morel, "Edge detection by Helmholtz principle", Journal of Mathematical Imaging and Vision 14, 2001).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats32, Mask
from tactflow.vision.contact.heights import Heights
from tactflow.vision.contact.level_tree import grow_level_lines

LEVEL_COUNT: Final = 12
"""Levels between the gel at rest and its highest point: their distance is a 13th of that height."""
MIN_CLIMB_SLOPE_RATIO: Final = 0.5
"""Minimum mean slope of outer lines that still belong to the climb to the object, relative to the
steepest."""
SEARCH_MARGIN_CELLS: Final = 3
"""Margin around the outermost of these lines in which the outline is searched, cells: cells are means over
three by three, and the shortest waves of the surface are four. With 2 to 6, outlines overlap equally well
with real ones within 0.01."""
MIN_LINE_CELLS: Final = 9
"""Minimum number of cells inside a line: three by three."""
MAX_AREA_SHARE: Final = 0.6
"""Maximum area of a contact, as a fraction of the picture: the rest must show gel at rest."""
MAX_BORDER_SHARE: Final = 0.5
"""Maximum fraction of a line along the border of the picture."""
SIGN_EVIDENCE_SLOPES: Final = 5.0
"""Accumulated evidence, in slopes of a frame's contact, that settles whether contacts are bumps or dents. The
wrong one is flatter by at least a tenth in all outlined frames, by three quarters in the median."""
MIN_SALIENCE_RATIO: Final = 0.5
"""Minimum salience of further contacts, relative to the first: less is gel that wrinkles, or light that has
changed elsewhere. Chosen on outlines of fifteen labs (0.2 and 0.35 overlap equally well within 0.01)."""
LEVELS: Final = np.arange(1, LEVEL_COUNT + 1, dtype=np.float32)
"""The levels, in units of their distance."""


class LevelLines(NamedTuple):
    """The level lines of a surface, from the highest level down.

    For each line, (n,): level : index of its level.

    Attributes
    ----------
    above : (h, w) int32, number of levels below each cell; holes are filled up to the line around them.
    inside : a cell inside, as y w + x.
    encloses : whether it encloses changed cells.
    slope : mean slope of the surface along it, per cell; 0 if it is too wide or too open for a contact.
    salience : slope in standard errors, up to a factor.
    outer : index of the line around it, or -1.
    """

    above: NDArray[np.int32]
    level: NDArray[np.int32]
    inside: NDArray[np.int32]
    encloses: Flags
    slope: Floats32
    salience: Floats32
    outer: NDArray[np.int32]


def level_lines(heights: Floats32, changed: Flags) -> LevelLines:
    """Level lines at evenly spaced levels; heights : (h, w) float32. changed : (h, w) bool."""
    levels = LEVELS * (heights.max() / np.float32(LEVEL_COUNT + 1))
    high, wide = heights.shape
    # All lines lie in a window, and touch its border only where it is the picture's.
    left, top, across, down = cv2.boundingRect((heights > levels[0]).view(np.uint8))
    window = slice(max(top - 1, 0), top + down + 1), slice(max(left - 1, 0), left + across + 1)
    surface = np.ascontiguousarray(heights[window])
    marked = np.ascontiguousarray(changed[window]).view(np.uint8)
    above = np.zeros((high, wide), np.int32)
    over = np.empty(surface.shape, np.int32)
    lines = np.empty((LEVEL_COUNT * surface.size // MIN_LINE_CELLS, 7), np.int32)
    drops = np.empty(len(lines), np.float32)
    count = grow_level_lines(surface, marked, levels, MIN_LINE_CELLS, over, drops, lines)
    above[window] = over
    level, inside, cells, enclosed, sides, border, outer = lines[:count].T
    y, x = np.divmod(inside, surface.shape[1])
    inside = (y + window[0].start) * wide + x + window[1].start
    # Averaged over directions, a line is pi / 4 as long as the sides of the cells along it.
    length = np.float32(math.pi / 4) * sides
    possible = (sides >= (1 - MAX_BORDER_SHARE) * (sides + border)) & (cells <= MAX_AREA_SHARE * heights.size)
    slope = np.asarray(drops[:count] * possible / np.maximum(length, np.float32(1)), np.float32)
    salience = slope * np.sqrt(length)
    return LevelLines(above, level, inside, enclosed > 0, slope, np.asarray(salience, np.float32), outer)


class ContactRegion(NamedTuple):
    """A region that holds the outline of a contact.

    Attributes
    ----------
    rows, columns : window of cells.
    inside : (h, w) bool, cells that may belong to the contact.
    core : (h, w) uint8, 1 in cells that certainly do.
    """

    rows: slice
    columns: slice
    inside: Flags
    core: Mask


class ContactFinder:
    """Finds the contacts of consecutive frames.

    The sign of the slopes is unknown, so a contact may look like a bump or a dent. The steeper of the two
    over all frames is the contact: around it the gel bulges the other way, but less steeply.
    """

    def __init__(self) -> None:
        self._bumps = 0.0

    def __call__(self, heights: Heights, changed: Flags) -> list[ContactRegion]:
        """Regions of disjoint contacts, the most salient one first.

        heights : of the gel's cells. changed : (h, w) bool; each contact encloses some of these cells.
        """
        values = heights.values if self._bumps >= 0 or not heights.sloping else -heights.values
        found = _contacts(values, changed)
        if heights.sloping and abs(self._bumps) <= SIGN_EVIDENCE_SLOPES * found.slope:
            others = _contacts(-values, changed)
            more = found.slope - others.slope
            if abs(self._bumps) + more < 0:
                found = others
            self._bumps += more if values is heights.values else -more
        return found.regions


class _Contacts(NamedTuple):
    """The contacts of a surface, the most salient first.

    Attributes
    ----------
    slope : of the first one's line; 0 without any.
    """

    regions: list[ContactRegion]
    slope: float


def _contacts(heights: Floats32, changed: Flags) -> _Contacts:
    """Select the most salient lines that are not nested, and grow each outwards to the end of its climb."""
    lines = level_lines(heights, changed)
    regions: list[ContactRegion] = []
    left, first, slope = lines.salience.copy(), 0.0, 0.0
    free = np.ones(left.size, np.bool_)
    while (salience := float(left.max(initial=0))) > 0 and salience >= MIN_SALIENCE_RATIO * first:
        steepest = int(left.argmax())
        outwards = _outwards(lines, steepest, free)
        wide = outwards[-1]
        if not lines.encloses[wide]:
            left[steepest] = 0
            continue
        if not regions:
            first, slope = salience, float(lines.slope[steepest])
        # The gel is steepest between this line and the next one.
        core, near = (_inside(lines, line) for line in (outwards[:2][-1], wide))
        regions.append(_region(core, near))
        # Nested lines belong to the same contact.
        free[: wide + 1][near.ravel()[lines.inside[: wide + 1]] > 0] = False
        while wide >= 0:
            free[wide] = False
            wide = lines.outer[wide]
        left *= free
    return _Contacts(regions, slope)


def _outwards(lines: LevelLines, steepest: int, free: Flags) -> list[int]:
    """The lines from the steepest one outwards, up to one that is much flatter or belongs to another
    contact."""
    found, least = [steepest], MIN_CLIMB_SLOPE_RATIO * lines.slope[steepest]
    while (outer := int(lines.outer[found[-1]])) >= 0 and free[outer] and lines.slope[outer] >= least:
        found.append(outer)
    return found


def _inside(lines: LevelLines, line: int) -> Mask:
    """(h, w) uint8: 1 in the cells inside a line, else 0."""
    cells = (lines.above > lines.level[line]).view(np.uint8)
    y, x = divmod(int(lines.inside[line]), cells.shape[1])
    cv2.floodFill(cells, None, (x, y), 2)
    return np.asarray(cells == 2).view(np.uint8)


def _region(core: Mask, near: Mask) -> ContactRegion:
    """The region of a contact; core : cells that certainly belong to it. near : cells inside the outer
    line."""
    high, wide = core.shape
    near = np.asarray(
        cv2.dilate(near, np.ones((2 * SEARCH_MARGIN_CELLS + 1, 2 * SEARCH_MARGIN_CELLS + 1), np.uint8)),
        np.uint8,
    )
    left, top, across, down = cv2.boundingRect(near)
    rows, columns = slice(max(top - 1, 0), top + down + 1), slice(max(left - 1, 0), left + across + 1)
    return ContactRegion(
        slice(rows.start, min(rows.stop, high)),
        slice(columns.start, min(columns.stop, wide)),
        np.ascontiguousarray(near[rows, columns]).view(np.bool_),
        np.ascontiguousarray(core[rows, columns]),
    )
