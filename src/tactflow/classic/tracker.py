"""The original script's marker tracking: contour centres matched to a grid by depth-first search."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.classic.functions import MARKER_AREAS, marker_center
from tactflow.vision.markers.detection import NoMarkersError
from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.types import Markers, MarkerStatus

FloatArray = NDArray[np.float64]

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


class GridFlow(NamedTuple):
    """The flow as the original returns it: five arrays of shape (rows, columns).

    Ox, Oy : original positions, px. Cx, Cy : current positions, px. Occupied : index of the matched centre,
    or -1.
    """

    Ox: FloatArray
    Oy: FloatArray
    Cx: FloatArray
    Cy: FloatArray
    Occupied: NDArray[np.int64]


class Matcher:
    """Matches centres to a grid of rows and columns by depth-first search.

    The script's `m.init`, `m.run` and `m.get_flow`. Row by row, each node tries the free centres that best
    continue the motion of its left and upper neighbours, or stays empty at a cost. A branch is pruned when it
    costs more than the best complete assignment.

    origin : (rows, columns, 2) float64, px; NaN where the grid has no marker.
    spacing : typical distance between neighbours, px. max_visits : see `MAX_VISITS`.
    """

    def __init__(self, origin: FloatArray, spacing: float, *, max_visits: int = MAX_VISITS) -> None:
        if origin.ndim != 3 or origin.shape[2] != 2:
            raise ValueError(f"required origin of shape (rows, columns, 2), got {origin.shape}")
        self._origin = origin
        self._spacing = spacing
        self._max_visits = max_visits
        rows, columns = origin.shape[:2]
        self._nodes = [
            (row, column)
            for row in range(rows)
            for column in range(columns)
            if np.isfinite(origin[row, column]).all()
        ]
        number = {node: index for index, node in enumerate(self._nodes)}
        self._before = [
            [
                number[near]
                for near in ((row, column - 1), (row - 1, column), (row - 1, column - 1))
                if near in number
            ][:2]
            for row, column in self._nodes
        ]
        self._places: list[complex] = [complex(*origin[node]) for node in self._nodes]
        self._centers: list[complex] = []
        self._best: list[int] = [-1] * len(self._nodes)
        self._moves: list[complex] = [0j] * len(self._nodes)

    def init(self, centers: FloatArray) -> None:
        """Set the centres (N, 2), px, of a frame."""
        self._centers = [complex(x, y) for x, y in centers]

    def run(self) -> None:
        """Search for the cheapest assignment, within `max_visits`."""
        count = len(self._nodes)
        empty_price = self._spacing**2
        chosen = [-1] * count
        moves = [0j] * count
        used: set[int] = set()
        best_cost = float("inf")
        costs = [0.0] * (count + 1)
        options: list[list[tuple[float, int, complex]]] = [[] for _ in range(count)]
        depth, visits = 0, 0
        if count:
            options[0] = self._options(0, moves, used, empty_price)
        while depth >= 0 and count:
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
                self._best, self._moves = chosen.copy(), moves.copy()
                continue
            costs[depth + 1] = total
            depth += 1
            options[depth] = self._options(depth, moves, used, empty_price)

    def _options(
        self, node: int, moves: list[complex], used: set[int], empty_price: float
    ) -> list[tuple[float, int, complex]]:
        """Options of a node, cheapest first: (cost, centre or -1, displacement)."""
        near = [moves[neighbour] for neighbour in self._before[node]]
        expected = sum(near) / len(near) if near else 0j
        place = self._places[node]
        candidates = []
        for index, center in enumerate(self._centers):
            move = center - place
            residual = abs(move - expected)
            if index not in used and residual < _REACH * self._spacing:
                candidates.append((residual**2, index, move))
        candidates.sort(key=lambda option: option[:2])
        return [*candidates[:_MAX_CANDIDATES], (empty_price, -1, expected)]

    def get_flow(self) -> GridFlow:
        """The result of the last `run`; nodes without a centre follow their neighbours."""
        shape = self._origin.shape[:2]
        current = self._origin.copy()
        occupied = np.full(shape, -1, np.int64)
        for node, center, place, move in zip(self._nodes, self._best, self._places, self._moves, strict=True):
            now = place + move
            current[node] = now.real, now.imag
            occupied[node] = center
        return GridFlow(
            self._origin[..., 0].copy(),
            self._origin[..., 1].copy(),
            current[..., 0],
            current[..., 1],
            occupied,
        )


class GridTracker:
    """The original tracker, on a grid found in the reference frame instead of typed in.

    reference : (H, W, 3) uint8, BGR.
    least_area, most_area : see `marker_center`.

    Raises
    ------
    NoMarkersError : fewer than four centres, or no grid in them.
    ValueError : the areas are not a finite range.
    """

    def __init__(
        self,
        reference: NDArray[np.uint8],
        *,
        least_area: float = MARKER_AREAS[0],
        most_area: float = MARKER_AREAS[1],
    ) -> None:
        if not 0 <= least_area < most_area < np.inf:
            raise ValueError(f"required 0 <= least_area < most_area, px^2, got {least_area}, {most_area}")
        self._areas = (least_area, most_area)
        centers = marker_center(reference, least_area=least_area, most_area=most_area)
        grid, spacing = grid_of(centers)
        self._present = np.isfinite(grid[..., 0])
        self._matcher = Matcher(grid, spacing)

    def track(self, image: NDArray[np.uint8]) -> Markers:
        """Match one frame; markers without a centre are inferred, standard errors are NaN."""
        least, most = self._areas
        self._matcher.init(marker_center(image, least_area=least, most_area=most))
        self._matcher.run()
        flow = self._matcher.get_flow()
        status = np.where(flow.Occupied[self._present] >= 0, MarkerStatus.TRACKED, MarkerStatus.INFERRED)
        return Markers(
            np.column_stack([flow.Ox[self._present], flow.Oy[self._present]]),
            np.column_stack([flow.Cx[self._present], flow.Cy[self._present]]),
            status.astype(np.uint8),
            np.full(int(self._present.sum()), np.nan),
        )


def grid_of(centers: FloatArray) -> tuple[FloatArray, float]:
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
            f"{len(centers)} markers found: is the sensor marker-less? then use pipelines/markerless.yaml"
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
            "0 markers found in a grid: is the sensor marker-less? then use pipelines/markerless.yaml"
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
