"""Match spots of a frame to marks, and interpolate invisible marks, because neighbours move alike."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial import KDTree

from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.markers.lattice import components, nearest

MAX_STRAIN: Final = 0.5
"""Strain of a link above which its two marks do not move together; 0.3 and 0.7 change no identity in six
scenes and seven recordings (measured)."""

SEARCH_RADIUS_PITCHES: Final = 0.4
"""Scatter of the displacement field, pitches: maximum distance of a spot from the predicted position of its
mark. With 0.3 three times as many marks of wedge_roll are missed, with 0.5 some take a shadow half a pitch
away (measured)."""

MIN_KNOWN_SHARE: Final = 0.15
"""Minimum share, by weight, of known neighbours to predict a mark: a single one is not enough. With 0.2,
jumps of 0.9 pitches cost identities; with 0.1, marks of sts_torque160, 3 px apart, take the spots of others
in 2 % of all cases (measured)."""

MAX_NEIGHBOURS: Final = 24
"""Maximum number of neighbours in a fit: the two rings of a square grid, 8 + 16."""

WEIGHT_SIGMA_PITCHES: Final = 1.1
"""Standard deviation of the Gaussian weight of a neighbour, pitches: the weight is 0.66 at one pitch. Chosen
by hand."""

RIDGE: Final = np.diag([1e-9, 0.05, 0.05, 0.3, 0.3, 0.3])
"""Ridge of the fit's coefficients 1, x, y, x^2, x y, y^2. It reduces a quadratic fit to a plane, and a plane
to a mean, where the data do not suffice. Chosen by hand."""


class MarkerGraph:
    """Marks and the links between neighbours.

    The strain of a link is the difference of the displacements of its two marks over their distance.

    Parameters
    ----------
    origin : (N, 2) float64, marks in the reference, px.
    edges : (E, 2) int64, neighbours.

    Raises
    ------
    ValueError : an edge has an invalid index.

    Examples
    --------
    >>> origin = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    >>> graph = MarkerGraph(origin, np.array([[0, 1], [1, 2]]))
    >>> seen = np.ones(3, bool)
    >>> smooth, torn = graph.check(origin + [[1.0, 0.0], [1.0, 0.0], [6.0, 0.0]], seen)
    >>> smooth, torn
    (array([ True, False]), True)
    >>> graph.largest_component(seen, smooth)
    array([ True,  True, False])
    """

    def __init__(self, origin: Floats, edges: Indices) -> None:
        count = len(origin)
        self._edges = np.ascontiguousarray(edges, np.int64).reshape(-1, 2)
        if len(self._edges) and not 0 <= self._edges.min() <= self._edges.max() < count:
            raise ValueError(f"required edges between marks 0 to {count - 1}, got {self._edges.tolist()}")
        self._origin = origin
        self._ends = np.ascontiguousarray(self._edges.T)
        length = np.linalg.norm(origin[self._ends[0]] - origin[self._ends[1]], axis=1)
        self._limit = (MAX_STRAIN * length) ** 2
        self._grid = components(self._edges, count)
        self.grids = [np.flatnonzero(self._grid == grid) for grid in np.unique(self._grid)]
        """The marks of each connected grid."""

    def check(self, position: Floats, seen: Flags) -> tuple[Flags, bool]:
        """Test the links between visible marks: which (E,) have little strain, and whether any has much.

        position : (N, 2), px. seen : (N,), whether a mark is visible.
        """
        one, other = self._ends
        moved = position - self._origin
        change = moved.take(one, axis=0) - moved.take(other, axis=0)
        change *= change
        smooth = change[:, 0] + change[:, 1] < self._limit
        both = seen.take(one) & seen.take(other)
        smooth &= both
        return smooth, bool(np.count_nonzero(smooth) < np.count_nonzero(both))

    def largest_component(self, seen: Flags, smooth: Flags) -> Flags:
        """The visible marks (N,) of the largest component of each grid, connected by links of little
        strain."""
        component = components(self._edges[smooth], len(seen))
        # The first of components of equal size.
        rank = np.where(seen, np.bincount(component)[component] - component / len(seen), 0.0)
        best = np.zeros(len(seen))
        np.maximum.at(best, self._grid, rank)
        return np.asarray(seen & (rank == best[self._grid]))


class Interpolator:
    """Interpolates marks from their neighbours.

    Parameters
    ----------
    origin : (N, 2) float64, marks in the reference, px.
    pitch : px.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    >>> origin = 10 * np.column_stack([x.ravel(), y.ravel()])
    >>> position = origin + 3
    >>> found = np.ones(25, bool)
    >>> found[12], position[12] = False, 0.0
    >>> placed = Interpolator(origin, 10.0).place(position, found)
    >>> placed.tolist(), (position[12] - origin[12]).round(2).tolist()
    ([12], [3.0, 3.0])
    """

    def __init__(self, origin: Floats, pitch: float) -> None:
        self._origin, self._pitch = origin, pitch
        self._around, self._weight = surroundings(origin, pitch)

    def place(self, position: Floats, found: Flags) -> Indices:
        """Interpolate the marks that were not found, if enough of their neighbours were.

        position : (N, 2) float64, px, finite, changed in place. found : (N,) bool.
        Returns the indices of the interpolated marks; the positions of others stay.
        """
        missing = np.flatnonzero(~found)
        around = self._around[missing]
        weight = self._weight[missing] * found[around]
        offset = (self._origin[around] - self._origin[missing][:, None]) / self._pitch
        moved = (position - self._origin)[around]
        x, y = offset[..., 0], offset[..., 1]
        basis = np.empty((*x.shape, 6))
        for number, term in enumerate((1.0, x, y, x * x, x * y, y * y)):
            basis[..., number] = term
        weighted = (basis * weight[:, :, None]).transpose(0, 2, 1)
        fitted = np.linalg.solve(weighted @ basis + RIDGE, weighted @ moved)[:, 0]
        supported = weight.sum(axis=1) > MIN_KNOWN_SHARE * self._weight[missing].sum(axis=1)
        placed = np.asarray(missing[supported], np.int64)
        position[placed] = self._origin[placed] + fitted[supported]
        return placed


def surroundings(origin: Floats, pitch: float) -> tuple[Indices, Floats]:
    """The up to 24 nearest neighbours of each mark, and their weights: two (N, n) arrays."""
    away, near = nearest(origin, MAX_NEIGHBOURS)
    return near, np.exp(-(away**2) / (2 * (WEIGHT_SIGMA_PITCHES * pitch) ** 2))


def grow(
    last: Floats, known: Flags, spots: Floats, interpolator: Interpolator, reach: Floats
) -> tuple[Indices, Indices]:
    """Assign spots to unknown marks, from the known marks outwards.

    In each round the known neighbours predict the position of a mark, which takes the nearest spot, unless
    that is farther away than its `reach` or nearer to another mark. Remaining marks take a remaining spot
    near their last position.

    Parameters
    ----------
    last : (N, 2) float64, px, current positions of the known marks, and last positions of the others.
    known : (N,) bool. spots : (M, 2) float64, px. interpolator : of the marks. reach : (N,) float64, px.

    Returns
    -------
    marks, chosen : (n,) int64, indices of marks and of the spots assigned to them, each spot at most once.

    Examples
    --------
    >>> origin = np.column_stack([10.0 * np.arange(4), np.zeros(4)])
    >>> now = origin + [[0.0, 0.0], [3.0, 0.0], [6.0, 0.0], [9.0, 0.0]]
    >>> known = np.array([True, False, False, False])
    >>> grow(origin, known, now[1:], Interpolator(origin, 10.0), np.full(4, 4.0))
    (array([1, 2, 3]), array([0, 1, 2]))
    """
    position, known = last.copy(), known.copy()
    choice, free = np.full(len(last), -1, np.int64), np.arange(len(spots))

    def take(asked: Indices) -> bool:
        nonlocal free
        away, nearest = map(np.asarray, KDTree(spots[free]).query(position[asked]))
        order = np.argsort(away, kind="stable")
        # The first mark of each spot is the nearest one.
        first = order[np.unique(nearest[order], return_index=True)[1]]
        first = first[away[first] < reach[asked[first]]]
        marks, taken = asked[first], nearest[first]
        choice[marks], known[marks], position[marks] = free[taken], True, spots[free[taken]]
        free = np.delete(free, taken)
        return len(first) > 0

    while len(free) and len(asked := interpolator.place(position, known)) and take(asked):
        pass
    left = np.flatnonzero(~known)
    position[left] = last[left]
    if len(free) and len(left):
        take(left)
    marks = np.flatnonzero(choice >= 0)
    return marks, choice[marks]


def common_displacement(position: Floats, spots: Floats, pitch: float, farthest: float) -> Floats:
    """The displacement of most marks, by votes of all pairs of a mark and a spot.

    Parameters
    ----------
    position : (N, 2) float64, marks before, px.
    spots : (M, 2) float64, spots now, px.
    pitch : px. farthest : largest displacement, px.

    Returns
    -------
    displacement : (2,) float64, px; zero if no spot is near enough.

    References
    ----------
    Ballard, "Generalizing the Hough transform to detect arbitrary shapes", Pattern Recognition 13 (1981).

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(0, 50, 10.0), np.arange(0, 50, 10.0))
    >>> position = np.column_stack([x.ravel(), y.ravel()])
    >>> common_displacement(position, position + [4.0, -3.0], pitch=10.0, farthest=13.0).round(6)
    array([ 4., -3.])
    """
    votes = (spots - position[:, None]).reshape(-1, 2)
    votes = votes[np.hypot(*votes.T) < farthest]
    if len(votes) == 0:
        return np.zeros(2)
    tree = KDTree(votes)
    best = np.asarray(
        tree.query_ball_point(votes, SEARCH_RADIUS_PITCHES * pitch, return_length=True)
    ).argmax()
    agree = tree.query_ball_point(votes[best], SEARCH_RADIUS_PITCHES * pitch)
    return np.asarray(votes[agree].mean(axis=0), np.float64)
