"""Marks and the links between neighbours: how the links are strained, and which marks move together."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

LINKED_STRAIN: Final = 0.3
"""Strain of a link below which its two marks move together. Chosen by hand."""

BORDER_WEIGHT: Final = 3
"""Votes of a mark at the border of the grid, against 1 of others. Chosen by hand: marks at the border hardly
move, so the component that holds them is the right one."""

LEAST_GRID: Final = 6
"""Marks of a grid beside others, at least: fewer are a group whose neighbours are hidden. Chosen by hand."""


class MarkerGraph:
    """Marks and the links between neighbours.

    The strain of a link is the difference of the displacements of its two marks over their distance.

    Parameters
    ----------
    origin : (N, 2) float64, marks in the reference, px.
    edges : (E, 2) int64, neighbours.

    Raises
    ------
    ValueError : an edge names a mark that there is not.

    Examples
    --------
    >>> origin = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    >>> graph = MarkerGraph(origin, np.array([[0, 1], [1, 2]]))
    >>> strain = graph.strain(origin + [[1.0, 0.0], [1.0, 0.0], [6.0, 0.0]])
    >>> strain
    array([0. , 0.5])
    >>> graph.largest_component(np.ones(3, bool), strain)
    array([ True,  True, False])
    """

    def __init__(self, origin: FloatArray, edges: IntArray) -> None:
        count = len(origin)
        self.edges = np.ascontiguousarray(edges, np.int64).reshape(-1, 2)
        if len(self.edges) and not 0 <= self.edges.min() <= self.edges.max() < count:
            raise ValueError(f"required edges between marks 0 to {count - 1}, got {self.edges.tolist()}")
        self._origin = origin
        self.length = np.linalg.norm(origin[self.edges[:, 0]] - origin[self.edges[:, 1]], axis=1)
        neighbours: list[list[tuple[int, int]]] = [[] for _ in range(count)]
        for number, (first, second) in enumerate(self.edges.tolist()):
            neighbours[first].append((second, number))
            neighbours[second].append((first, number))
        degree = [len(links) for links in neighbours]
        usual = sorted(degree)[len(degree) // 2]
        self.border = np.array([links < usual for links in degree])
        """(N,) bool, marks with fewer neighbours than most."""
        home = np.array(_grids(neighbours), np.int64)
        grids = [np.flatnonzero(home == name) for name in np.unique(home)]
        self.grids = [grid for grid in grids if len(grid) >= LEAST_GRID] or [np.arange(count)]
        """The marks of each grid without links to others, small groups left out unless all are."""
        self._votes = np.where(self.border, BORDER_WEIGHT, 1).astype(np.int64)
        self._grid = home
        links = [link for of_mark in neighbours for link in of_mark]
        self._links = np.array(links, np.int64).reshape(-1, 2)
        self._begin = np.cumsum([0, *degree], dtype=np.int64)

    def strain(self, position: FloatArray) -> FloatArray:
        """Strain of each link (E,), of positions (N, 2), px."""
        strain = np.empty(len(self.edges))
        link_strains(position, self._origin, self.edges, self.length, strain)
        return strain

    def largest_component(self, seen: BoolArray, strain: FloatArray) -> BoolArray:
        """The seen marks (N,) of the largest component whose links have little strain (E,).

        Marks at the border have more votes. Where the marks of the reference form several grids without
        links between them, each has its own component.
        """
        inliers = np.zeros(len(seen), np.bool_)
        largest_components(seen, strain, self._begin, self._links, self._votes, self._grid, inliers)
        return inliers


def _grids(neighbours: list[list[tuple[int, int]]]) -> list[int]:
    """For each mark the smallest mark that it is linked to, directly or through others."""
    grid = [-1] * len(neighbours)
    for seed in range(len(neighbours)):
        if grid[seed] >= 0:
            continue
        grid[seed] = seed
        members = [seed]
        for mark in members:
            for other, _ in neighbours[mark]:
                if grid[other] < 0:
                    grid[other] = seed
                    members.append(other)
    return grid


@kernel("void(float64[:, ::1], float64[:, ::1], int64[:, ::1], float64[::1], float64[::1])")
def link_strains(
    position: FloatArray, origin: FloatArray, edges: IntArray, length: FloatArray, strain: FloatArray
) -> None:
    """What `MarkerGraph.strain` finds."""
    for e in range(len(edges)):
        one, other = edges[e, 0], edges[e, 1]
        change_x = (position[one, 0] - origin[one, 0]) - (position[other, 0] - origin[other, 0])
        change_y = (position[one, 1] - origin[one, 1]) - (position[other, 1] - origin[other, 1])
        strain[e] = np.sqrt(change_x * change_x + change_y * change_y) / length[e]


@kernel("void(boolean[::1], float64[::1], int64[::1], int64[:, ::1], int64[::1], int64[::1], boolean[::1])")
def largest_components(
    seen: BoolArray,
    strain: FloatArray,
    first: IntArray,
    links: IntArray,
    votes: IntArray,
    grid: IntArray,
    inliers: BoolArray,
) -> None:
    """What `MarkerGraph.largest_component` finds.

    first : (N + 1,) where the links of each mark begin. links : (2 E, 2), the neighbour and the number of the
    edge.
    """
    count = len(seen)
    waiting = seen.copy()
    # The marks of a component, one component after the other.
    order = np.empty(count, np.int64)
    heaviest, begin, end = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    heaviest[:] = begin[:] = end[:] = 0
    filled = 0
    for seed in range(count):
        if not waiting[seed]:
            continue
        waiting[seed] = False
        start = filled
        order[filled] = seed
        filled += 1
        weight = 0
        next_mark = start
        while next_mark < filled:
            mark = order[next_mark]
            next_mark += 1
            weight += votes[mark]
            for link in range(first[mark], first[mark + 1]):
                other = links[link, 0]
                if waiting[other] and strain[links[link, 1]] < LINKED_STRAIN:
                    waiting[other] = False
                    order[filled] = other
                    filled += 1
        home = grid[seed]
        if weight > heaviest[home]:
            heaviest[home], begin[home], end[home] = weight, start, filled
    inliers[:] = False
    for home in range(count):
        for number in range(begin[home], end[home]):
            inliers[order[number]] = True
