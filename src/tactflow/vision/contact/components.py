"""Connected components of the cells that have changed: which of them are contacts, and where.

`contact_components` closes small gaps between the cells, parts them, keeps the parts that are strong enough,
and leaves out stray ones. `wide_change` finds those that are faint, but wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats32, Mask

SQUARE: Final = np.ones((3, 3), np.uint8)
"""A cell and its neighbours."""
STRAY: Final = 0.04
"""Separate changes with less of the summed squared deviation than this part of the strongest one's are no
contacts of their own: wrinkles, reflections, what is left of a marker that was removed. Chosen on wrs_cam1,
whose stray reflections hold 0.01 to 0.03, and franka_mini, where the faint second edge of an object holds
0.045 and more; the lesser of two simulated contacts holds 0.55 and more."""
MAX_COMPONENTS: Final = 12
"""At most so many changes are contacts. Chosen by hand."""
MIN_CELLS: Final = 8
"""Cells that must change together. Chosen by hand: 128 px^2 is the halo of a ball's first touch."""
WIDE_DEVIATION: Final = 12.0
"""Squared deviation of the colour from which a cell counts as part of a wide change: 1 of 400 by chance
(chi-square with two degrees of freedom)."""


class Component(NamedTuple):
    """A connected change.

    rows, columns : its window, cells. inside : (h, w) bool, which cells of the window belong. cells : how
    many do. peak : the largest squared deviation.
    """

    rows: slice
    columns: slice
    inside: Flags
    cells: int
    peak: float


def union(components: list[Component], shape: tuple[int, ...]) -> Flags:
    """(h, w) bool: cells of all components.

    >>> import numpy as np
    >>> union([Component(slice(0, 1), slice(1, 3), np.array([[True, True]]), 2, 9.0)], (2, 3)).sum()
    np.int64(2)
    """
    cells = np.zeros(shape, np.bool_)
    for rows, columns, inside, *_ in components:
        window = cells[rows, columns]
        # Windows of several may overlap.
        window[:] = inside if len(components) == 1 else window | inside
    return cells


def wide_change(colour: Floats32, extent: float) -> Flags | None:
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
    squared: Floats32, weak: float, start: float, stay: float, before: Flags | None
) -> list[Component]:
    """Connected changes that are contact, the strongest first if there are several.

    squared : (h, w) float32, squared deviations. weak : a cell above belongs to a contact if connected to it.
    start : a peak that makes a new contact. stay : a peak that keeps one. before : (h, w) bool, the cells in
    contact in the previous frame.

    >>> import numpy as np
    >>> squared = np.zeros((9, 9), np.float32)
    >>> squared[2:6, 2:6] = 20
    >>> [(found.rows, found.columns) for found in contact_components(squared, 5, 10, 10, None)]
    [(slice(1, 7, None), slice(1, 7, None))]
    """
    changed = np.asarray(cv2.morphologyEx((squared > weak).view(np.uint8), cv2.MORPH_CLOSE, SQUARE), np.uint8)
    least = min(MIN_CELLS, squared.size // 4)
    parts = _parts(changed, squared, least)
    large = [part for part in parts if part.cells >= least]
    found = [part for part in large if part.peak >= start or (part.peak >= stay and _overlaps(part, before))]
    return _strongest(found, squared)


def _parts(changed: Mask, squared: Floats32, least: int) -> list[Component]:
    """Each connected part of what has changed.

    least : cells of a part's bounding box, below which it is left out.
    """
    outlines, _ = cv2.findContours(changed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    parts = []
    for index, outline in enumerate(outlines):
        bounds = cv2.boundingRect(outline)
        if bounds[2] * bounds[3] < least:
            continue
        rows, columns = window = _window(bounds, changed.shape)
        filled = changed[window].copy()
        if len(outlines) > 1:
            own = np.zeros_like(filled)
            cv2.drawContours(own, outlines, index, 1, cv2.FILLED, offset=(-columns.start, -rows.start))
            filled &= own
        peak = cv2.minMaxLoc(squared[window], filled)[1]
        parts.append(Component(*window, filled.view(np.bool_), cv2.countNonZero(filled), peak))
    return parts


def _window(bounds: Sequence[int], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a bounding box (left, top, width, height), and a cell more on all sides."""
    left, top, wide, high = bounds
    rows = slice(max(top - 1, 0), min(top + high + 1, shape[0]))
    return rows, slice(max(left - 1, 0), min(left + wide + 1, shape[1]))


def _overlaps(component: Component, cells: Flags | None) -> bool:
    """Whether a component has any of these cells, (h, w)."""
    return cells is not None and bool((cells[component.rows, component.columns] & component.inside).any())


def _strongest(components: list[Component], squared: Floats32) -> list[Component]:
    """The components without stray ones, by their summed squared deviation."""
    if len(components) < 2:
        return components
    sums = [float(squared[part.rows, part.columns][part.inside].sum()) for part in components]
    order = sorted(range(len(components)), key=lambda index: -sums[index])
    return [components[index] for index in order[:MAX_COMPONENTS] if sums[index] >= STRAY * sums[order[0]]]
