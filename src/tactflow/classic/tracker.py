"""The original script's marker tracking: contour centres matched to a grid by depth-first search."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from tactflow.classic.functions import marker_center
from tactflow.vision.arrays import Floats
from tactflow.vision.markers.detection import NoMarkersError
from tactflow.vision.markers.lattice import neighbour_graph, pitch_of
from tactflow.vision.types import Markers, MarkerStatus

MAX_VISITS: Final = 5000
"""Nodes that the search may visit per frame, about as many as Python visits in the original's time limit of
33 ms. Unlike a time limit, it gives the same result on every machine."""

_SEARCH_RADIUS_SPACINGS: Final = 0.6
"""Search radius around the position predicted from the neighbours, as a fraction of the spacing; chosen by
hand: beyond a half, a centre may belong to the neighbour."""

_MAX_CANDIDATES: Final = 3
"""Centres that a node tries before it stays empty; chosen by hand."""

_MAX_LINK_SPACINGS: Final = 1.6
"""Maximum link length in median nearest-neighbour distances: more than the diagonal of a square, so that a
bent grid stays linked, and less than two spacings."""

_MAX_COMPONENT_RATIO: Final = 0.6
"""Maximum ratio of a link's shorter to its longer component: 1 for the diagonal of a square, 0.6 for a row
tilted by 31 degrees."""


class Matcher:
    """Matches centres to a grid of rows and columns by depth-first search.

    The script's `m`. Row by row, each node tries the free centres that best continue the motion of its left
    and upper neighbours, or stays empty at a cost. A branch is pruned when it costs more than the best
    complete assignment.

    Parameters
    ----------
    grid : (rows, columns, 2) float64, px; NaN where there is no marker.
    spacing : typical distance between neighbours, px.
    max_visits : see `MAX_VISITS`.
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
            if index not in used and residual < _SEARCH_RADIUS_SPACINGS * self._spacing:
                candidates.append((residual**2, index, move))
        candidates.sort(key=lambda option: option[:2])
        return [*candidates[:_MAX_CANDIDATES], (self._spacing**2, -1, expected)]


class GridTracker:
    """The original tracker, on a grid found in the reference frame instead of typed in.

    Parameters
    ----------
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
    grid : (rows, columns, 2) float64, px, NaN where a node has no centre; centres not linked to the largest
        part of the grid are left out. spacing : median distance between linked centres, px.

    Raises
    ------
    NoMarkersError : fewer than four centres, or no links between them.
    """
    if len(centers) < 4:
        raise NoMarkersError(
            f"{len(centers)} markers found: is the sensor marker-less? then use the pipeline markerless"
        )
    links = neighbour_graph(centers, _MAX_LINK_SPACINGS * pitch_of(centers))
    steps = centers[links[:, 1]] - centers[links[:, 0]]
    lengths = np.abs(steps)
    straight = lengths.min(axis=1) <= _MAX_COMPONENT_RATIO * lengths.max(axis=1)
    links, steps, lengths = links[straight], steps[straight], lengths[straight]
    if not len(links):
        raise NoMarkersError(
            "0 markers found in a grid: is the sensor marker-less? then use the pipeline markerless"
        )
    # One row down or up, or one column right or left.
    moves = (np.sign(steps) * (lengths == lengths.max(axis=1, keepdims=True)))[:, ::-1].astype(int)
    move = {(a, b): way for (a, b), way in zip(links.tolist(), moves, strict=True)}
    move |= {(b, a): -way for (a, b), way in move.items()}
    graph = coo_array((np.ones(len(links)), links.T), (len(centers), len(centers))).tocsr()
    component = connected_components(graph, directed=False)[1]
    start = int(np.flatnonzero(component == np.bincount(component).argmax())[0])
    order, before = breadth_first_order(graph, start, directed=False)
    places = {start: np.zeros(2, int)}
    for center in order[1:].tolist():
        places[center] = places[int(before[center])] + move[int(before[center]), center]
    nodes = np.array([places[center] for center in order.tolist()])
    nodes -= nodes.min(axis=0)
    grid = np.full((*(nodes.max(axis=0) + 1), 2), np.nan)
    grid[tuple(nodes.T)] = centers[order]
    return grid, float(np.median(np.hypot(*steps.T)))
