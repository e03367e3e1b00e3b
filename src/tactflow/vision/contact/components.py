"""Connected components of the cells that have changed."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Float = NDArray[np.float32]
Cells = NDArray[np.bool_]

STRAY: Final = 0.04
"""Separate changes with less of the summed squared deviation than this part of the strongest one's are no
contacts of their own: wrinkles, reflections, what is left of a marker that was removed. Chosen on wrs_cam1,
whose stray reflections hold 0.01 to 0.03, and franka_mini, where the faint second edge of an object holds
0.045 and more; the lesser of two simulated contacts holds 0.55 and more."""
MAX_COMPONENTS: Final = 12
"""At most so many contacts are outlined. Chosen by hand."""
MIN_CELLS: Final = 8
"""Cells that must change together. Chosen by hand: 128 px^2 is the halo of a ball's first touch."""
WIDE_DEVIATION: Final = 12.0
"""Squared deviation of the colour from which a cell counts as part of a wide change: 1 of 400 by chance
(chi-square with two degrees of freedom)."""


class Component(NamedTuple):
    """A connected change.

    rows, columns : its window, cells. inside : (h, w) bool, which cells of the window belong.
    """

    rows: slice
    columns: slice
    inside: Cells


def union(components: list[Component], shape: tuple[int, ...]) -> Cells:
    """(h, w) bool: cells of all components.

    >>> import numpy as np
    >>> union([Component(slice(0, 1), slice(1, 3), np.array([[True, True]]))], (2, 3)).sum()
    np.int64(2)
    """
    cells = np.zeros(shape, np.bool_)
    for rows, columns, inside in components:
        cells[rows, columns] |= inside
    return cells


def wide_change(colour: Float, extent: float) -> Cells | None:
    """Cells of connected changes of colour that cover `extent` cells at least.

    colour : (h, w) float32, squared deviations. Returns (h, w) bool, or None if there is no such change.

    >>> import numpy as np
    >>> colour = np.zeros((9, 9), np.float32)
    >>> colour[2:6, 2:6] = 20
    >>> wide_change(colour, 16).sum(), wide_change(colour, 17)
    (np.int64(16), None)
    """
    changed = (colour > WIDE_DEVIATION).view(np.uint8)
    if cv2.countNonZero(changed) < extent:
        return None
    _, labels, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
    wide = stats[:, cv2.CC_STAT_AREA] >= extent
    wide[0] = False
    return np.asarray(wide[labels], np.bool_) if wide.any() else None


def contact_components(
    squared: Float, weak: float, start: float, stay: float, before: Cells | None
) -> list[Component]:
    """Connected changes that are contact, the strongest first if there are several.

    squared : (h, w) float32, squared deviations. weak : a cell above belongs to a contact if connected to it.
    start : a peak that makes a new contact. stay : a peak that keeps one. before : (h, w) bool, the cells
    in contact in the previous frame.

    >>> import numpy as np
    >>> squared = np.zeros((9, 9), np.float32)
    >>> squared[2:6, 2:6] = 20
    >>> [(found.rows, found.columns) for found in contact_components(squared, 5, 10, 10, None)]
    [(slice(1, 7, None), slice(1, 7, None))]
    """
    changed = np.empty(squared.shape, np.uint8)
    close_changes(squared, weak, changed)
    outlines, _ = cv2.findContours(changed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    height, width = squared.shape
    least = min(MIN_CELLS, squared.size // 4)
    found: list[Component] = []
    for outline in outlines:
        left, top, wide, high = cv2.boundingRect(outline)
        if wide * high < least:
            continue
        rows = slice(max(top - 1, 0), min(top + high + 1, height))
        columns = slice(max(left - 1, 0), min(left + wide + 1, width))
        filled = changed[rows, columns].copy()
        if len(outlines) > 1:
            own = np.zeros_like(filled)
            cv2.drawContours(own, [outline], 0, 1, cv2.FILLED, offset=(-columns.start, -rows.start))
            filled &= own
        if cv2.countNonZero(filled) < least:
            continue
        inside = filled.view(np.bool_)
        peak = cv2.minMaxLoc(squared[rows, columns], filled)[1]
        if peak >= start or (
            before is not None and peak >= stay and bool((before[rows, columns] & inside).any())
        ):
            found.append(Component(rows, columns, inside))
    return _strongest(found, squared)


def _strongest(components: list[Component], squared: Float) -> list[Component]:
    """The components without stray ones, by their summed squared deviation."""
    if len(components) < 2:
        return components
    sums = [float(squared[rows, columns][inside].sum()) for rows, columns, inside in components]
    order = sorted(range(len(components)), key=lambda index: -sums[index])
    return [components[index] for index in order[:MAX_COMPONENTS] if sums[index] >= STRAY * sums[order[0]]]


@kernel("void(float32[:, ::1], float32, uint8[:, ::1])")
def close_changes(squared: Float, weak: float, closed: NDArray[np.uint8]) -> None:
    """1 where `squared` is above `weak`, after closing by 3 x 3, else 0; `closed` is filled."""
    high, wide = squared.shape
    # A border of one cell for each step: what is outside neither grows nor erodes.
    grown = np.ones((high + 2, wide + 2), np.uint8)
    above = np.zeros((high + 2, wide + 2), np.uint8)
    line = np.empty(wide + 2, np.uint8)
    for y in range(high):
        row = above[y + 1, 1:]
        for x in range(wide):
            row[x] = np.uint8(squared[y, x] > weak)
    for y in range(high):
        upper, here, lower, row = above[y], above[y + 1], above[y + 2], grown[y + 1, 1:]
        for x in range(wide + 2):
            line[x] = upper[x] | here[x] | lower[x]
        for x in range(wide):
            row[x] = line[x] | line[x + 1] | line[x + 2]
    for y in range(high):
        upper, here, lower, row = grown[y], grown[y + 1], grown[y + 2], closed[y]
        for x in range(wide + 2):
            line[x] = upper[x] & here[x] & lower[x]
        for x in range(wide):
            row[x] = line[x] & line[x + 1] & line[x + 2]
