"""The component tree of a surface: how its level lines are nested, and the slope along each.

A level line is the border of a connected component of cells above a level. Components are grown from the
highest level down by union-find (L. Najman, M. Couprie, "Building the component tree in quasi-linear time",
IEEE Transactions on Image Processing 15, 2006).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Mask
from tactflow.vision.compiled import helper, kernel

Numbers = NDArray[np.int32]


@kernel(
    "int64(float32[:, ::1], uint8[:, ::1], float32[::1], int64, int32[:, ::1], float32[::1], int32[:, ::1])",
)
def grow_level_lines(
    heights: Floats32,
    marked: Mask,
    levels: Floats32,
    least: int,
    above: Numbers,
    drops: Floats32,
    lines: Numbers,
) -> int:
    """Measure the level lines of a surface, from the highest level down; returns their number.

    heights, marked : (h, w), the surface, and cells to count (non-zero). levels : (l,) ascending. least :
    minimum number of cells inside a line.
    above : (h, w), filled with the number of levels below each cell, or below the lines around it.
    drops : (n,), filled with the sum of the surface's slope along each line, per cell.
    lines : (n, 7), filled with each line's level, as an index; one of the cells inside, as y w + x; the
    number of cells inside; the number of marked ones; the number of cell sides along the line, and along the
    border of the picture; and the index of the line around it, or -1.
    """
    high, wide = heights.shape
    z, marks = heights.ravel(), marked.ravel()
    order, ends = _by_level(heights, levels, above.ravel())
    root = np.full(z.size, -1, np.int32)
    # For each root: number of cells, of marked ones, of sides along the line and along the border.
    sizes, drop = np.zeros((z.size, 4), np.int32), np.zeros(z.size, np.float32)
    line_of = np.full(z.size, -1, np.int32)
    count, inner = 0, 0
    for level in range(levels.size - 1, -1, -1):
        for i in range(ends[level + 1], ends[level]):
            cell = order[i]
            sizes[cell, 0], sizes[cell, 1] = 1, marks[cell] != 0
            _join(cell, z, high, wide, root, sizes, drop)
        outer = count
        for i in range(ends[level]):
            cell = order[i]
            if root[cell] == cell and sizes[cell, 0] >= least:
                drops[count] = drop[cell]
                lines[count, 0], lines[count, 1], lines[count, 6] = level, cell, -1
                lines[count, 2:6] = sizes[cell]
                line_of[cell] = count
                count += 1
        for line in range(inner, outer):
            lines[line, 6] = line_of[_root_of(root, lines[line, 1])]
        inner = outer
    return count


@helper
def _join(
    cell: int, z: Floats32, high: int, wide: int, root: Numbers, sizes: Numbers, drop: Floats32
) -> None:
    """Unite a cell with the components beside it; their common sides no longer belong to a line."""
    root[cell] = cell
    y, x = cell // wide, cell % wide
    for dy, dx in ((-1, 0), (0, -1), (0, 1), (1, 0)):
        here = _root_of(root, cell)
        if not (0 <= y + dy < high and 0 <= x + dx < wide):
            sizes[here, 3] += 1
            continue
        beside = cell + dy * wide + dx
        fall = z[cell] - z[beside]
        if root[beside] < 0:
            sizes[here, 2] += 1
            drop[here] += fall
            continue
        there = _root_of(root, beside)
        sizes[there, 2] -= 1
        drop[there] += fall
        if there != here:
            root[here] = there
            drop[there] += drop[here]
            for j in range(4):
                sizes[there, j] += sizes[here, j]


@helper
def _by_level(heights: Floats32, levels: Floats32, above: Numbers) -> tuple[Numbers, Numbers]:
    """Cells from the highest level down, and the number of cells above each level.

    Holes are filled: a cell counts as above a level if every path from the border of the picture to it climbs
    above that level (P. Soille, "Morphological Image Analysis", 2004, ch. 6).
    """
    high, wide = heights.shape
    above[:] = -1
    # Linked lists of the cells that are reached at each level: the first one, and the one after each.
    first, after = np.full(levels.size + 1, -1, np.int32), np.empty(heights.size, np.int32)
    for y in range(high):
        for x in range(0, wide, 1 if y in (0, high - 1) else max(wide - 1, 1)):
            _reach(y * wide + x, _level_of(heights[y, x], levels), above, first, after)
    ends = np.zeros(levels.size + 1, np.int32)
    order, last = np.empty(heights.size, np.int32), heights.size
    for level in range(levels.size + 1):
        if level > 0:
            ends[level - 1] = last
        while first[level] >= 0:
            cell = first[level]
            first[level] = after[cell]
            last -= 1
            order[last] = cell
            y, x = cell // wide, cell % wide
            for v in range(max(y - 1, 0), min(y + 2, high)):
                for u in range(max(x - 1, 0), min(x + 2, wide)):
                    if above[v * wide + u] < 0:
                        up = max(level, _level_of(heights[v, u], levels))
                        _reach(v * wide + u, up, above, first, after)
    return order, ends


@helper
def _level_of(value: float, levels: Floats32) -> int:
    """The number of levels below a value."""
    level = 0
    while level < levels.size and value > levels[level]:
        level += 1
    return level


@helper
def _reach(cell: int, level: int, above: Numbers, first: Numbers, after: Numbers) -> None:
    """Put a cell into the list of a level."""
    above[cell] = level
    after[cell] = first[level]
    first[level] = cell


@helper
def _root_of(root: Numbers, cell: int) -> int:
    """Root of the component of a cell, with path halving."""
    while root[cell] != cell:
        root[cell] = root[root[cell]]
        cell = root[cell]
    return cell
