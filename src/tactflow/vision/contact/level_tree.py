"""The component tree of a surface: how its level lines are nested, and the slope along each.

A level line is the border of a connected component of cells above a level. Components are grown from the
highest level down by union-find (L. Najman, M. Couprie, "Building the component tree in quasi-linear time",
IEEE Transactions on Image Processing 15, 2006).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from tactflow.vision.arrays import Floats32, Mask, Numbers
from tactflow.vision.compiled import kernel


@kernel
def grow_level_lines(
    heights: Floats32,
    marked: Mask,
    levels: Floats32,
    least: int,
    within: Numbers,
    drops: Floats32,
    lines: Numbers,
) -> int:
    """Measure the level lines of a surface, from the highest level down; returns their number.

    Holes are filled: a cell counts as above a level if every path from the border of the picture to it climbs
    above that level (P. Soille, "Morphological Image Analysis", 2004, ch. 6).

    heights, marked : (h, w), the surface, and cells to count (non-zero). levels : (l,) ascending. least :
    minimum number of cells inside a line.
    within : (h, w), filled with the index of the innermost line around each cell, or -1.
    drops : (n,), filled with the sum of the surface's slope along each line, per cell.
    lines : (n, 7), filled with each line's level, as an index; one of the cells inside, as y w + x; the
    number of cells inside; the number of marked ones; the number of cell sides along the line, and along the
    border of the picture; and the index of the line around it, or -1.
    """
    count, inner = 0, 0
    within[:] = -1
    high = np.argwhere(heights > levels[0]) if len(levels) else np.empty((0, 2), np.int64)
    if not len(high):
        return 0
    # All lines lie in a window, and touch its border only where it is the picture's.
    window = tuple(map(slice, np.maximum(high.min(axis=0) - 1, 0), high.max(axis=0) + 2))
    cell_of = np.arange(heights.size).reshape(heights.shape)[window].ravel()
    heights, marked, within = heights[window], marked[window], within[window]
    for level in range(len(levels) - 1, -1, -1):
        outside, _ = label(np.pad(heights <= levels[level], 1, constant_values=True), np.ones((3, 3)))
        inside = outside[1:-1, 1:-1] != outside[0, 0]
        found, number = label(inside)
        parts = np.asarray(found, np.int32)
        sizes = np.bincount(parts.ravel(), minlength=number + 1)
        counted = np.bincount(parts.ravel(), marked.ravel() != 0, minlength=number + 1)
        sides, border, falls = _along(parts, heights, number)
        cells = np.zeros(number + 1, np.int64)
        cells[parts.ravel()] = np.arange(parts.size)
        line_of = np.full(number + 1, -1)
        outer = count
        for part in np.flatnonzero(sizes[1:] >= least) + 1:
            lines[count] = (level, cells[part], sizes[part], counted[part], sides[part], border[part], -1)
            drops[count] = falls[part]
            line_of[part] = count
            count += 1
        lines[inner:outer, 6] = line_of[parts.ravel()[lines[inner:outer, 1]]]
        within[:] = np.where(within < 0, line_of[parts], within)
        inner = outer
    lines[:count, 1] = cell_of[lines[:count, 1]]
    return count


def _along(parts: Numbers, heights: Floats32, number: int) -> tuple[Numbers, Numbers, Floats32]:
    """Of each part: sides along its line, sides along the border of the picture, and the slope's sum."""
    padded = np.pad(parts, 1, constant_values=-1)
    surface = np.pad(heights, 1)
    sums = np.zeros((3, number + 1))
    for rows, columns in ((0, 1), (2, 1), (1, 0), (1, 2)):
        window = slice(rows, rows + parts.shape[0]), slice(columns, columns + parts.shape[1])
        beside, fall = padded[window], heights - surface[window]
        at_line, at_border = beside == 0, beside < 0
        for into, weight in zip(sums, (at_line, at_border, fall * at_line), strict=True):
            into += np.bincount(parts.ravel(), weight.ravel(), minlength=number + 1)
    return sums[0].astype(np.int32), sums[1].astype(np.int32), sums[2].astype(np.float32)
