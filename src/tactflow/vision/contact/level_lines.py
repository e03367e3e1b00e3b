"""Contacts as level lines of the shape of a gel.

Around an object the gel climbs from rest to the object, so the mean slope along a level line is largest where
it leaves the object. The salience of a line is its mean slope in standard errors, which shrink with the
square root of its length: a long line is less likely to be steep by chance (A. Desolneux, L. Moisan, J.-M.
Morel, "Edge detection by Helmholtz principle", Journal of Mathematical Imaging and Vision 14, 2001).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes, Flags, Floats32, Mask, Numbers
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.components import SQUARE
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


class ContactRegion(NamedTuple):
    """A region that holds the outline of a contact.

    Attributes
    ----------
    rows, columns : window of cells.
    inside : (h, w) bool, cells that may belong to the contact.
    core : (h, w) uint8, 1 in cells that certainly do.
    inner : (h, w) uint8, 1 in those surrounded by others, if there are any: changes are smoothed by a cell.
    """

    rows: slice
    columns: slice
    inside: Flags
    core: Mask
    inner: Mask


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
        unsigned = heights.sloping and heights.slopes is None
        values = -heights.values if unsigned and self._bumps < 0 else heights.values
        regions, slope = _contacts(values, changed)
        if unsigned and abs(self._bumps) <= SIGN_EVIDENCE_SLOPES * slope:
            others, other_slope = _contacts(-values, changed)
            more = slope - other_slope
            if abs(self._bumps) + more < 0:
                regions = others
            self._bumps += more if values is heights.values else -more
        return regions


def _contacts(heights: Floats32, changed: Flags) -> tuple[list[ContactRegion], float]:
    """The contacts at evenly spaced levels, the most salient first, and the slope of the first one's line, 0
    without any; heights : (h, w) float32. changed : (h, w) bool."""
    levels = np.arange(1, LEVEL_COUNT + 1, dtype=np.float32) * (heights.max() / np.float32(LEVEL_COUNT + 1))
    within, contacts = np.empty((2, *heights.shape), np.int32)
    lines = np.empty((LEVEL_COUNT * heights.size // MIN_LINE_CELLS, 7), np.int32)
    drops = np.empty(len(lines), np.float32)
    count = grow_level_lines(heights, changed.view(np.uint8), levels, MIN_LINE_CELLS, within, drops, lines)
    boxes = np.empty((count, 4), np.int32)
    limits = MIN_CLIMB_SLOPE_RATIO, MAX_BORDER_SHARE, MAX_AREA_SHARE, MIN_SALIENCE_RATIO
    number, slope = select_contacts(lines[:count], drops[:count], within, contacts, boxes, *limits)
    found = enumerate(boxes[: int(number)].tolist())
    return [_region(contacts, 2 * index + 1, box) for index, box in found], slope


@kernel
def select_contacts(
    lines: Numbers,
    drops: Floats32,
    within: Numbers,
    contacts: Numbers,
    boxes: Numbers,
    climb: float,
    most_border: float,
    most_area: float,
    least_ratio: float,
) -> tuple[float, float]:
    """Select the most salient lines that are not nested, and grow each outwards to the end of its climb.

    Returns the number of contacts, and the slope of the first one's line; 0 without any.

    lines, drops, within : of `grow_level_lines`. contacts : (h, w), filled: 2 i + 2 in the core of the i-th
    contact, 2 i + 1 in other cells inside its outer line, 0 elsewhere. boxes : (n, 4), filled from its start:
    first row and column of each contact, last ones plus 1. climb : `MIN_CLIMB_SLOPE_RATIO`.
    most_border : `MAX_BORDER_SHARE`. most_area : `MAX_AREA_SHARE`. least_ratio : `MIN_SALIENCE_RATIO`.
    """
    _, _, cells, enclosed, sides, border, outer = lines.T
    # Averaged over directions, a line is pi / 4 as long as the sides of the cells along it.
    length = math.pi / 4 * sides
    possible = (sides >= (1 - most_border) * (sides + border)) & (cells <= most_area * within.size)
    slope = np.asarray(drops * possible / np.maximum(length, 1), np.float32)
    salience = np.asarray(slope * np.sqrt(length), np.float32)
    free = np.ones(len(lines), np.bool_)
    contacts[:] = 0
    number, first, largest = 0, 0.0, 0.0
    while (most := float(salience.max(initial=0))) > 0 and most >= least_ratio * first:
        steepest = int(salience.argmax())
        outwards, least = [steepest], climb * slope[steepest]
        while (line := int(outer[outwards[-1]])) >= 0 and free[line] and slope[line] >= least:
            outwards.append(line)
        if not enclosed[outwards[-1]]:
            salience[steepest] = 0
            continue
        if not number:
            first, largest = most, float(slope[steepest])
        # The gel is steepest between this line and the next one.
        core, near = (_lines_inside(line, outer) for line in (outwards[:2][-1], outwards[-1]))
        contacts += (2 * number + 1) * near[within] + core[within]
        y, x = near[within].nonzero()
        boxes[number] = y.min(), x.min(), y.max() + 1, x.max() + 1
        # Nested lines belong to the same contact.
        free[near[:-1]] = False
        line = outwards[-1]
        while line >= 0:
            free[line] = False
            line = int(outer[line])
        salience *= free
        number += 1
    return number, largest


def _lines_inside(line: int, outer: Numbers) -> Flags:
    """(n + 1,) bool: whether each of n lines is this one or lies inside it; the last one stands for none."""
    inside = np.zeros(len(outer) + 1, np.bool_)
    inside[line] = True
    for inner in range(line - 1, -1, -1):
        inside[inner] = inside[outer[inner]]
    return inside


def _region(contacts: Numbers, near: int, box: Sequence[int]) -> ContactRegion:
    """The region of a contact from `select_contacts`; near : number in its cells outside the core."""
    margin = SEARCH_MARGIN_CELLS + 1
    rows = slice(max(box[0] - margin, 0), min(box[2] + margin, contacts.shape[0]))
    columns = slice(max(box[1] - margin, 0), min(box[3] + margin, contacts.shape[1]))
    inside = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.bool_)
    cores = np.empty((2, *inside.shape), np.uint8)
    fill_region(contacts, near, rows.start, columns.start, SEARCH_MARGIN_CELLS, inside, cores)
    return ContactRegion(rows, columns, inside, *cores)


@kernel
def fill_region(
    contacts: Numbers, near: int, top: int, left: int, margin: int, inside: Flags, cores: Bytes
) -> None:
    """Fill the cells of a `ContactRegion`.

    contacts, near : as for `_region`. top, left : of the window. margin : cells. inside : (h, w). cores :
    (2, h, w), the core and its inner part.
    """
    window = contacts[top:, left:][: inside.shape[0], : inside.shape[1]]
    core = (window == near + 1).view(np.uint8)
    square = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    inside[:] = cv2.dilate(core | (window == near).view(np.uint8), square)
    inner = cv2.erode(core, SQUARE)
    cores[:] = core, inner if inner.any() else core
