"""Marks and the links between neighbours: how the links are strained, and which marks move together."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Indices

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

    def __init__(self, origin: Floats, edges: Indices) -> None:
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
        self._votes = np.where(self.border, BORDER_WEIGHT, 1).tolist()
        self._grid = home.tolist()
        self._neighbours = neighbours

    def strain(self, position: Floats) -> Floats:
        """Strain of each link (E,), of positions (N, 2), px."""
        moved = position - self._origin
        x, y = (moved[self.edges[:, 0]] - moved[self.edges[:, 1]]).T
        return np.asarray(np.sqrt(x * x + y * y) / self.length)

    def largest_component(self, seen: Flags, strain: Floats) -> Flags:
        """The seen marks (N,) of the largest component whose links have little strain (E,).

        Marks at the border have more votes. Where the marks of the reference form several grids without
        links between them, each has its own component.
        """
        linked, waiting = (strain < LINKED_STRAIN).tolist(), seen.tolist()
        best: dict[int, tuple[int, list[int]]] = {}
        for seed, home in enumerate(self._grid):
            if not waiting[seed]:
                continue
            waiting[seed] = False
            component = [seed]
            for mark in component:
                for other, edge in self._neighbours[mark]:
                    if waiting[other] and linked[edge]:
                        waiting[other] = False
                        component.append(other)
            votes = sum(self._votes[mark] for mark in component)
            if votes > best.get(home, (0, []))[0]:
                best[home] = (votes, component)
        inliers = np.zeros(len(seen), np.bool_)
        for _, component in best.values():
            inliers[component] = True
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
