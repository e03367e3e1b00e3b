"""Contacts as level lines of the shape of a gel.

Around an object the gel climbs from rest to the object, so the mean slope along a level line is largest where
it leaves the object (A. Desolneux, L. Moisan, J.-M. Morel, "Edge detection by Helmholtz principle", Journal
of Mathematical Imaging and Vision 14, 2001, who take the contrast along level lines to find what stands out).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats32, Mask
from tactflow.vision.contact.heights import Heights

LEVELS: Final = 16
"""Levels at which lines are drawn: the steepest one lies within a thirtieth of the height."""
FLATTER: Final = 0.5
"""Part of the steepest line's mean slope that a line around it has at least where the gel still climbs to the
object."""
BESIDE: Final = 2
"""Cells beside that line in which the outline is looked for: cells are means over three by three."""
SHORTEST: Final = 10
"""Cells of the shortest line: around a contact of three by three."""
WIDEST: Final = 0.6
"""Part of the picture that a contact covers at most: something else has to be at rest."""
OPEN: Final = 0.5
"""Part of a line that may run along the border of the picture."""
LENGTH: Final = 0.25
"""Power of its length with which a line's slope counts: of two lines of the same slope, the longer one is the
less likely chance. 0 and 0.5 overlap as well with real outlines within 0.02."""
DECIDED: Final = 30.0
"""How many times the salience of a frame's contact decides for good between a bump and a dent."""
LESSER: Final = 0.5
"""Part of the first contact's salience that a further one has at least: less is gel that wrinkles, or light
that has changed elsewhere. Chosen on outlines of fifteen labs (0.2 and 0.35 overlap as well within 0.01)."""


class Line(NamedTuple):
    """A level line, closed or cut off by the border of the picture.

    level : of the surface on it. cells : (n, 1, 2) int32, x and y of the cells along it, just inside.
    length : how many of them are not at the border. slope : mean of the surface's slope along these. outer :
    index of the line around it, or -1.
    """

    level: float
    cells: NDArray[np.int32]
    length: int
    slope: float
    outer: int

    @property
    def salience(self) -> float:
        """How much it stands out."""
        return self.slope * math.pow(self.length, LENGTH)


def level_lines(heights: Floats32) -> list[Line]:
    """Lines at evenly spaced levels, from the lowest up; heights : (h, w) float32."""
    across = cv2.Scharr(heights, cv2.CV_32F, 1, 0, scale=1 / 32)
    down = cv2.Scharr(heights, cv2.CV_32F, 0, 1, scale=1 / 32)
    slope = np.asarray(cv2.magnitude(across, down), np.float32)
    # Along the border of the picture, a line is none.
    slope[[0, -1]] = slope[:, [0, -1]] = 0
    least, most = float(heights.min()), float(heights.max())
    lines: list[Line] = []
    below: list[tuple[int, cv2.typing.MatLike]] = []
    for level in np.linspace(least, most, LEVELS + 2)[1:-1].tolist():
        outlines, _ = cv2.findContours(
            (heights > level).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        here: list[tuple[int, cv2.typing.MatLike]] = []
        for outline in outlines:
            if len(outline) < SHORTEST:
                continue
            x, y = outline[:, 0].T
            along = slope[y, x]
            length = np.count_nonzero(along)
            if length < (1 - OPEN) * len(outline) or cv2.contourArea(outline) > WIDEST * heights.size:
                continue
            here.append((len(lines), outline))
            place = outline[0, 0].tolist()
            outer = next((i for i, around in below if cv2.pointPolygonTest(around, place, False) >= 0), -1)
            mean = float(along.sum()) / length
            lines.append(Line(level, np.asarray(outline, np.int32), int(length), mean, outer))
        below = here
    return lines


class ContactRegion(NamedTuple):
    """Where the outline of a contact lies.

    rows, columns : window of cells. inside : (h, w) bool, which of them may belong to the contact. core :
    (h, w) uint8, 1 where they do.
    """

    rows: slice
    columns: slice
    inside: Flags
    core: Mask


class ContactFinder:
    """Finds the contacts of frames, one after the other.

    Slopes do not tell a bump from a dent. Of both, the one whose lines stand out more over all frames is the
    contact: around it the gel bulges the other way, but less steeply.
    """

    def __init__(self) -> None:
        self._bumps = 0.0

    def __call__(self, heights: Heights, changed: Flags) -> list[ContactRegion]:
        """Regions that do not overlap, the most salient one first.

        heights : of the gel's cells. changed : (h, w) bool, cells of which each contact encloses some.
        """
        values = heights.values if self._bumps >= 0 or heights.slopes is None else -heights.values
        contacts = _contacts(level_lines(values), changed)
        if heights.slopes is not None and abs(self._bumps) <= DECIDED * _salience(contacts):
            others = _contacts(level_lines(-values), changed)
            more = _salience(contacts) - _salience(others)
            if abs(self._bumps) + more < 0:
                contacts = others
            self._bumps += more if values is heights.values else -more
        return [_region(*contact, changed.shape) for contact in contacts]


def _salience(contacts: Sequence[tuple[Line, Line]]) -> float:
    return contacts[0][0].salience if contacts else 0.0


def _region(steepest: Line, wide: Line, shape: tuple[int, ...]) -> ContactRegion:
    """The cells inside the steepest line; and those inside a wider one, and beside it."""
    core, near = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    cv2.drawContours(core, [steepest.cells], -1, 1.0, cv2.FILLED)
    cv2.drawContours(near, [wide.cells], -1, 1.0, cv2.FILLED)
    near = np.asarray(cv2.dilate(near, np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), np.uint8)), np.uint8)
    left, top, across, down = cv2.boundingRect(near)
    rows, columns = slice(max(top - 1, 0), top + down + 1), slice(max(left - 1, 0), left + across + 1)
    return ContactRegion(
        slice(rows.start, min(rows.stop, shape[0])),
        slice(columns.start, min(columns.stop, shape[1])),
        np.ascontiguousarray(near[rows, columns]).view(np.bool_),
        np.ascontiguousarray(core[rows, columns]),
    )


def _contacts(lines: Sequence[Line], changed: Flags) -> list[tuple[Line, Line]]:
    """The steepest line of each contact, and a wider one around it; the most salient contact first.

    Lines inside each other are of one contact.
    """
    contacts: list[tuple[Line, Line]] = []
    related: set[int] = set()
    for index in sorted(range(len(lines)), key=lambda index: -lines[index].salience):
        if lines[index].salience < LESSER * _salience(contacts):
            break
        if index in related or lines[index].level <= 0:
            continue
        wide = _outermost(lines, index)
        if _encloses(lines[wide], changed):
            contacts.append((lines[index], lines[wide]))
            related |= _related(lines, wide)
    return contacts


def _outermost(lines: Sequence[Line], index: int) -> int:
    """The outermost of the lines around one that are not much flatter."""
    least = FLATTER * lines[index].slope
    while lines[index].outer >= 0 and lines[lines[index].outer].slope >= least:
        index = lines[index].outer
    return index


def _related(lines: Sequence[Line], index: int) -> set[int]:
    """A line with those around it and those inside."""
    related, around = {index}, lines[index].outer
    for inner, line in enumerate(lines):
        # Lines inside come after those around them.
        if line.outer in related:
            related.add(inner)
    while around >= 0:
        related.add(around)
        around = lines[around].outer
    return related


def _encloses(line: Line, cells: Flags) -> bool:
    """Whether there are any of these cells, (h, w), inside or on a line."""
    left, top, wide, high = cv2.boundingRect(line.cells)
    inside = np.zeros((high, wide), np.uint8)
    cv2.drawContours(inside, [line.cells], -1, 1.0, cv2.FILLED, offset=(-left, -top))
    return bool((inside.view(np.bool_) & cells[top : top + high, left : left + wide]).any())
