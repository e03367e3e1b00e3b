"""Which spot of a frame is which mark: neighbours move alike.

All costs are in one unit: a link between neighbours whose displacements differ by half their distance costs
0.5.

References
----------
Pearl, "Probabilistic reasoning in intelligent systems" (1988); Felzenszwalb and Huttenlocher, "Efficient
belief propagation for early vision", IJCV 70 (2006).
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Floats, Indices
from tactflow.vision.markers.lattice import components

LINKED_STRAIN: Final = 0.3
"""Strain of a link below which its two marks move together. Chosen by hand."""

MISSING_COST: Final = 1.0
"""Cost of a mark without a spot. Chosen by hand."""

MISSING_LINK_COST: Final = 0.25
"""Cost of each link of a mark without a spot. Chosen by hand."""

SURPRISE_COST: Final = 0.25
"""Cost of a mark one pitch away from where it was expected; grows with the square. Chosen by hand."""

FAINT_COST: Final = 1.0
"""Cost of a spot without any contrast; falls linearly to 0 at that of a typical mark. Chosen by hand."""

STRAIN_COST: Final = 2.0
"""Cost of a link at a strain of 1; grows with the square. It defines the unit."""

SHARED_COST: Final = 4.0
"""Cost of two neighbours that choose one spot: more than two marks without one."""

LABELS: Final = 8
"""Spots among which a mark may choose: its nearest. Chosen by hand."""

ROUNDS: Final = 24
"""Rounds of propagation, at most. Chosen by hand: messages pass over so many links."""

STABLE_ROUNDS: Final = 3
"""Propagation ends when the best labels did not change so many rounds in a row. Chosen by hand."""

BIN: Final = 0.1
"""Side of the bins of votes for a jump, pitches. Chosen by hand."""

AGREEMENT: Final = 2
"""Votes within so many bins of the peak agree with it: a fifth of a pitch for the scatter of the field."""

RIVAL: Final = 5
"""Another peak is looked for from so many bins on, half a pitch: nearer ones belong to the same peak."""

LEAST_VOTES: Final = 0.75
"""Fraction of the marks that have to agree on a jump. Chosen by hand."""

LEAST_LEAD: Final = 0.05
"""Lead over the next peak, as a fraction of the marks. Chosen by hand."""


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
        degree = np.bincount(self.edges.ravel(), minlength=count)
        self.border = degree < np.sort(degree)[count // 2]
        """(N,) bool, marks with fewer neighbours than most."""
        self._grid = components(self.edges, count)
        self.grids = [np.flatnonzero(self._grid == grid) for grid in np.unique(self._grid)]
        """The marks of each grid without links to others."""

    def strain(self, position: Floats) -> Floats:
        """Strain of each link (E,), of positions (N, 2), px."""
        moved = position - self._origin
        x, y = (moved[self.edges[:, 0]] - moved[self.edges[:, 1]]).T
        return np.asarray(np.sqrt(x * x + y * y) / self.length)

    def largest_component(self, seen: Flags, strain: Floats) -> Flags:
        """The seen marks (N,) of the largest component, in each grid, whose links have little strain (E,)."""
        linked = (strain < LINKED_STRAIN) & seen[self.edges].all(axis=1)
        component = components(self.edges[linked], len(seen))
        # Of components of one size the first one.
        rank = np.where(seen, np.bincount(component)[component] - component / len(seen), 0.0)
        best = np.zeros(len(seen))
        np.maximum.at(best, self._grid, rank)
        return np.asarray(seen & (rank == best[self._grid]))


def choose_spots(
    origin: Floats,
    edges: Indices,
    free: Indices,
    inliers: Flags,
    displacement: Floats,
    expected: Floats,
    spots: Floats,
    strength: Floats,
    *,
    pitch: float,
    farthest: float,
) -> Indices:
    """Give each free mark one of the spots, or none.

    The choice minimises unary costs (distance from where a mark is expected, faint spots, marks without a
    spot) and costs of links (squared strain), also of links to inliers, by min-sum belief propagation.

    Parameters
    ----------
    origin : (N, 2) float64, marks in the reference, px. edges : (E, 2) int64, neighbours.
    free : (n,) int64, marks that choose.
    inliers : (N,) bool, marks whose `displacement` (N, 2) float64, px, is known.
    expected : (k, n, 2) float64, k predictions of where the free marks are, px; the nearest one counts.
    spots : (M, 2) float64, px. strength : (M,) float64, 1 for a typical mark, less for faint ones.
    pitch : px. farthest : a spot no farther than this from a prediction may be chosen, px.

    Returns (n,) int64, number of the spot, -1 for none; no spot is chosen twice. Raises IndexError where
    `edges` or `free` name marks that there are not.

    Examples
    --------
    >>> origin = np.array([[0.0, 0.0], [10.0, 0.0]])
    >>> choose_spots(origin, np.array([[0, 1]]), np.array([0, 1]), np.zeros(2, bool), np.zeros((2, 2)),
    ...     origin[None], np.array([[6.0, 0.0], [16.0, 0.0]]), np.ones(2), pitch=10.0, farthest=13.0)
    array([0, 1])
    """
    count = len(free)
    if count == 0 or len(spots) == 0:
        return np.full(count, -1, np.int64)
    away = np.linalg.norm(expected[:, :, None] - spots, axis=3).min(axis=0)
    label = np.argsort(away, axis=1, kind="stable")[:, :LABELS]
    away = np.take_along_axis(away, label, axis=1)
    unary = np.full((count, label.shape[1] + 1), MISSING_COST)
    cost = SURPRISE_COST * (away / pitch) ** 2 + FAINT_COST * np.maximum(1.0 - strength[label], 0.0)
    unary[:, :-1] = np.where(away > farthest, np.inf, cost)
    # With the displacement to each label of each mark; that of an inlier is the same for all.
    moved = np.repeat(displacement[:, None], label.shape[1], axis=1)
    moved[free] = spots[label] - origin[free][:, None]
    slot: Indices = np.full(len(origin), -1, np.int64)
    slot[free] = np.arange(count)
    for ends in (edges, edges[:, ::-1]):
        mark, anchor = ends[(slot[ends[:, 0]] >= 0) & inliers[ends[:, 1]]].T
        np.add.at(unary, slot[mark], _link_costs(origin, moved, mark, anchor)[:, :, 0])
    inner = edges[(slot[edges] >= 0).all(axis=1)]
    pair = _link_costs(origin, moved, *inner.T)
    first, second = slot[inner].T
    pair[:, :-1, :-1] += SHARED_COST * (label[first][:, :, None] == label[second][:, None, :])
    return _assign(_beliefs(unary, first, second, pair), label)


def _link_costs(origin: Floats, moved: Floats, first: Indices, second: Indices) -> Floats:
    """(links, L + 1, L + 1) what the labels of two marks cost together; the last label is that of no spot.

    moved : (N, L, 2), displacement of each mark to each of its spots.
    """
    labels = moved.shape[1]
    length = np.linalg.norm(origin[second] - origin[first], axis=1)
    change = moved[second][:, None, :] - moved[first][:, :, None]
    cost = np.full((len(first), labels + 1, labels + 1), MISSING_LINK_COST)
    cost[:, :-1, :-1] = STRAIN_COST * (change**2).sum(axis=3) / length[:, None, None] ** 2
    return cost


def _beliefs(unary: Floats, first: Indices, second: Indices, pair: Floats) -> Floats:
    """Costs of each mark's labels, (n, L + 1), by min-sum belief propagation; of all links at once.

    unary : (n, L + 1). first, second : (links,), the marks of each link. pair : (links, L + 1, L + 1).
    """
    source, target = np.concatenate([first, second]), np.concatenate([second, first])
    cost = np.concatenate([pair, pair.transpose(0, 2, 1)])
    message = np.zeros((len(source), unary.shape[1]))
    belief, choice, unchanged = unary, unary.argmin(axis=1), 0
    for _ in range(ROUNDS if len(first) else 0):
        back = np.concatenate([message[len(first) :], message[: len(first)]])
        message = ((belief[source] - back)[:, :, None] + cost).min(axis=1)
        message -= message.min(axis=1, keepdims=True)
        belief = unary.copy()
        np.add.at(belief, target, message)
        latest = belief.argmin(axis=1)
        unchanged = unchanged + 1 if (latest == choice).all() else 0
        if unchanged == STABLE_ROUNDS:
            break
        choice = latest
    return belief


def _assign(belief: Floats, label: Indices) -> Indices:
    """The cheapest spot of each mark, (n,), -1 for none; of two that want one spot, the surer one gets it."""
    best = belief.argmin(axis=1)
    rows = np.arange(len(best))
    chosen: Indices = np.append(label, np.full((len(label), 1), -1), axis=1)[rows, best]
    surest = np.argsort(belief[rows, best] - belief[:, -1], kind="stable")
    _, first = np.unique(chosen[surest], return_index=True)
    kept = np.zeros(len(chosen), bool)
    kept[surest[first]] = True
    return np.where(kept, chosen, -1)


def common_displacement(position: Floats, spots: Floats, *, pitch: float, farthest: float) -> Floats | None:
    """The displacement that nearly all marks share, if there is clearly one.

    Every pair of a mark and a spot votes for its displacement. Only this tells a jump of the whole grid by
    nearly a pitch from a small one the other way, which all marks but those of one side would agree with.

    Parameters
    ----------
    position : (N, 2) float64, marks before, px.
    spots : (M, 2) float64, spots now, px.
    pitch : px. farthest : largest displacement, px.

    Returns
    -------
    displacement : (2,) float64, px; None where fewer than three quarters of the marks agree, or nearly as
        many agree with another.

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
    if len(spots) == 0:
        return None
    reach = int(farthest / (BIN * pitch))
    votes = (spots - position[:, None]).reshape(-1, 2)
    bins = np.rint(votes / (BIN * pitch)).astype(np.int64)
    near = (np.abs(bins) <= reach).all(axis=1)
    votes, bins = votes[near], bins[near] + reach
    counts = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    np.add.at(counts, (bins[:, 1], bins[:, 0]), 1)
    side = 2 * AGREEMENT + 1
    around = cv2.boxFilter(counts, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    row, column = np.unravel_index(int(np.argmax(around)), around.shape)
    agree = (np.abs(bins - (column, row)) <= AGREEMENT).all(axis=1)
    most, count = int(agree.sum()), len(position)
    around[max(row - RIVAL, 0) : row + RIVAL + 1, max(column - RIVAL, 0) : column + RIVAL + 1] = 0
    if most < LEAST_VOTES * count or most < float(around.max()) + LEAST_LEAD * count:
        return None
    return np.asarray(votes[agree].mean(axis=0), np.float64)
