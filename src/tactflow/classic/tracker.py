"""The original script's marker tracking: contour centres matched to a grid by depth-first search."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.classic.functions import marker_center
from tactflow.vision.arrays import Floats
from tactflow.vision.markers.detection import NoMarkersError
from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.types import Markers, MarkerStatus

MAX_VISITS: Final = 5000
"""Nodes that the search may visit per frame, about as many as Python visits in the original's time limit of
33 ms. Unlike a time limit, it gives the same result on every machine."""

_REACH: Final = 0.6
"""Search radius around the position predicted from the neighbours, as a fraction of the spacing; chosen by
hand: beyond a half, a centre may belong to the neighbour."""

_MAX_CANDIDATES: Final = 3
"""Centres that a node tries before it stays empty; chosen by hand."""

_LONGEST_LINK: Final = 1.6
"""Maximum link length in median nearest-neighbour distances: more than the diagonal of a square, so that a
bent grid stays linked, and less than two spacings."""

_OBLIQUE: Final = 0.6
"""Maximum ratio of a link's shorter to its longer component: 1 for the diagonal of a square, 0.6 for a row
tilted by 31 degrees."""


class Matcher:
    """Matches centres to a grid of rows and columns by depth-first search.

    The script's `m`. Row by row, each node tries the free centres that best continue the motion of its left
    and upper neighbours, or stays empty at a cost. A branch is pruned when it costs more than the best
    complete assignment.

    grid : (rows, columns, 2) float64, px; NaN where there is no marker.
    spacing : typical distance between neighbours, px. max_visits : see `MAX_VISITS`.
    """

    def __init__(self, grid: Floats, spacing: float, *, max_visits: int = MAX_VISITS) -> None:
        self._spacing = spacing
        self._max_visits = max_visits
        nodes = [(row, column) for row, column in np.argwhere(np.isfinite(grid[..., 0])).tolist()]
        number = {node: index for index, node in enumerate(nodes)}
        self._before = [
            [
                number[near]
                for near in ((row, column - 1), (row - 1, column), (row - 1, column - 1))
                if near in number
            ][:2]
            for row, column in nodes
        ]
        self._places: list[complex] = [complex(*grid[node]) for node in nodes]

    def match(self, centers: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Search for the cheapest assignment of centres (N, 2), px, within `max_visits`.

        Returns
        -------
        position : (M, 2), px, of the markers of the grid, row by row; those without a centre follow their
            neighbours. matched : (M,) index of the matched centre, or -1.
        """
        matched, moves = self._search([complex(x, y) for x, y in centers])
        now = np.array(self._places) + np.array(moves)
        return np.column_stack([now.real, now.imag]), np.array(matched, np.int64)

    def _search(self, centers: list[complex]) -> tuple[list[int], list[complex]]:
        """The centre, or -1, and the displacement of each node."""
        count = len(self._places)
        chosen, moves = [-1] * count, [0j] * count
        best = chosen.copy(), moves.copy()
        best_cost = float("inf")
        used: set[int] = set()
        costs = [0.0] * (count + 1)
        options: list[list[tuple[float, int, complex]]] = [[] for _ in range(count)]
        options[0] = self._options(0, centers, moves, used)
        depth, visits = 0, 0
        while depth >= 0:
            if chosen[depth] >= 0:
                used.discard(chosen[depth])
                chosen[depth] = -1
            if not options[depth]:
                depth -= 1
                continue
            cost, center, move = options[depth].pop(0)
            total = costs[depth] + cost
            if total >= best_cost:
                options[depth] = []
                continue
            visits += 1
            if visits > self._max_visits:
                break
            chosen[depth], moves[depth] = center, move
            if center >= 0:
                used.add(center)
            if depth + 1 == count:
                best_cost = total
                best = chosen.copy(), moves.copy()
                continue
            depth += 1
            costs[depth] = total
            options[depth] = self._options(depth, centers, moves, used)
        return best

    def _options(
        self, node: int, centers: list[complex], moves: list[complex], used: set[int]
    ) -> list[tuple[float, int, complex]]:
        """Options of a node, cheapest first: (cost, centre or -1, displacement)."""
        near = [moves[neighbour] for neighbour in self._before[node]]
        expected = sum(near) / len(near) if near else 0j
        candidates = []
        for index, center in enumerate(centers):
            move = center - self._places[node]
            residual = abs(move - expected)
            if index not in used and residual < _REACH * self._spacing:
                candidates.append((residual**2, index, move))
        candidates.sort(key=lambda option: option[:2])
        return [*candidates[:_MAX_CANDIDATES], (self._spacing**2, -1, expected)]


class GridTracker:
    """The original tracker, on a grid found in the reference frame instead of typed in.

    reference : (H, W, 3) uint8, BGR.

    Raises
    ------
    NoMarkersError : fewer than four centres, or no grid in them.
    """

    def __init__(self, reference: NDArray[np.uint8]) -> None:
        grid, spacing = grid_of(marker_center(reference))
        self._origin = grid[np.isfinite(grid[..., 0])]
        self._matcher = Matcher(grid, spacing)

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Match one frame; markers without a centre are inferred, standard errors are NaN."""
        position, matched = self._matcher.match(marker_center(image))
        status = np.where(matched >= 0, MarkerStatus.TRACKED, MarkerStatus.INFERRED).astype(np.uint8)
        return Markers(self._origin.copy(), position, status, np.full(len(status), np.nan))


def grid_of(centers: Floats) -> tuple[Floats, float]:
    """Arrange centres that lie on a (bent) grid in rows and columns.

    Parameters
    ----------
    centers : (N, 2) float64, px.

    Returns
    -------
    grid : (rows, columns, 2) float64, px, NaN where a node has no centre; centres not linked to the grid are
        left out. spacing : median distance between linked centres, px.

    Raises
    ------
    NoMarkersError : fewer than four centres, or no links between them.
    """
    if len(centers) < 4:
        raise NoMarkersError(
            f"{len(centers)} markers found: is the sensor marker-less? then use the pipeline markerless"
        )
    squared = ((centers[:, None] - centers[None]) ** 2).sum(axis=2)
    np.fill_diagonal(squared, np.inf)
    nearest = float(np.median(np.sqrt(squared.min(axis=1))))
    links: dict[int, list[tuple[int, int, int]]] = {}
    lengths = []
    for first, second in neighbour_graph(centers, _LONGEST_LINK * nearest).tolist():
        step = centers[second] - centers[first]
        along, across = np.abs(step).max(), np.abs(step).min()
        if across > _OBLIQUE * along:
            continue
        lengths.append(float(np.hypot(*step)))
        sign = 1 if step[np.argmax(np.abs(step))] > 0 else -1
        down, right = (0, sign) if abs(step[0]) > abs(step[1]) else (sign, 0)
        links.setdefault(first, []).append((second, down, right))
        links.setdefault(second, []).append((first, -down, -right))
    if not links:
        raise NoMarkersError(
            "0 markers found in a grid: is the sensor marker-less? then use the pipeline markerless"
        )
    largest: dict[tuple[int, int], int] = {}
    for start in sorted(links, key=lambda center: -len(links[center])):
        reached = {start: (0, 0)}
        queue = [start]
        for center in queue:
            row, column = reached[center]
            for neighbour, down, right in links[center]:
                if neighbour not in reached:
                    reached[neighbour] = (row + down, column + right)
                    queue.append(neighbour)
        component = {node: center for center, node in reversed(reached.items())}
        if len(component) > len(largest):
            largest = component
        if 2 * len(largest) > len(centers):
            break
    rows, columns = np.array(list(largest)).T
    grid = np.full((int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1, 2), np.nan)
    grid[rows - rows.min(), columns - columns.min()] = centers[list(largest.values())]
    return grid, float(np.median(lengths))
