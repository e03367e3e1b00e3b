"""Which spot of a frame is which mark: a joint choice by belief propagation, so that neighbours move alike.

All costs are in one unit: a link between neighbours whose displacements differ by half their distance costs
0.5.

References
----------
Pearl, "Probabilistic reasoning in intelligent systems" (1988); Felzenszwalb and Huttenlocher, "Efficient
belief propagation for early vision", IJCV 70 (2006).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Flags, Floats, Indices

ComplexArray = NDArray[np.complex128]

MISSING_COST: Final = 1.0
"""Cost of a mark without a spot. Chosen by hand."""

MISSING_LINK_COST: Final = 0.25
"""Cost of each link of a mark without a spot. Chosen by hand."""

SURPRISE_COST: Final = 0.25
"""Cost of a mark one pitch away from where it was expected; grows with the square. Chosen by hand."""

FAINT_COST: Final = 0.4
"""Cost of a spot without any contrast; falls linearly to 0 at that of a typical mark. Chosen by hand."""

STRAIN_COST: Final = 2.0
"""Cost of a link at a strain of 1; grows with the square. It defines the unit."""

MOST_STRAIN_COST: Final = 1.2
"""Bound of the cost of a link, so that a torn field is still possible. Chosen by hand."""

FOLD_STRAIN: Final = -0.75
"""Strain along a link below which it folds: at -1 one mark would lie on top of the other."""

FOLD_COST: Final = 1.0
"""Cost of a folded link. Chosen by hand."""

SHARED_COST: Final = 4.0
"""Cost of two neighbours that choose one spot. Chosen by hand."""

FORBIDDEN_COST: Final = 1e3
"""Cost of a spot that is too far away: more than all others together."""

LABELS: Final = 8
"""Spots among which a mark may choose: its nearest. Chosen by hand."""

SMOOTH_STRAIN: Final = 0.35
"""Strain of every link below which everybody's own best spot is taken for the joint best. Chosen by hand."""

STABLE_ROUNDS: Final = 3
"""Propagation ends when the best labels did not change so many rounds in a row. Chosen by hand."""

MOST_ROUNDS: Final = 24
"""Propagation ends after so many rounds at the latest. Chosen by hand."""

DAMPING: Final = 0.3
"""Fraction of the old message in the new one: keeps messages around loops from oscillating. Chosen by
hand."""


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
    spot) and costs of links (squared strain, bounded, with a penalty for folding), also of links to inliers.
    Where everybody's own best is not smooth already, min-sum belief propagation seeks the minimum.

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
    named = np.concatenate([edges.ravel(), free])
    if named.min() < 0 or named.max() >= len(origin):
        raise IndexError(f"required marks 0 to {len(origin) - 1} in edges and free, got others")
    slot: Indices = np.full(len(origin), -1, np.int64)
    slot[free] = np.arange(count)
    known = np.asarray(inliers, np.bool_)
    links = _Links(_complex(origin), edges, free, slot, known, _complex(displacement))
    places = _complex(spots)
    label, unary = _near_spots(_complex(expected), places, strength, pitch, farthest)
    chosen = _own_best(links, places, label, unary)
    if chosen is None:
        chosen = _assign(_beliefs(unary, *_link_costs(links, places, label)), label)
    return chosen


class _Links(NamedTuple):
    """Marks and their links, where points and displacements are complex numbers x + i y.

    rest : (N,) complex128, marks in the reference, px. slot : (N,), the number of each mark among the free
    ones, or -1. The others as in `choose_spots`.
    """

    rest: ComplexArray
    edges: Indices
    free: Indices
    slot: Indices
    inliers: Flags
    displacement: ComplexArray


def _complex(points: Floats) -> ComplexArray:
    """x + i y, which makes lengths and inner products of many pairs cheap."""
    return np.asarray(points[..., 0] + 1j * points[..., 1], np.complex128)


def _near_spots(
    expected: ComplexArray, spots: ComplexArray, strength: Floats, pitch: float, farthest: float
) -> tuple[Indices, Floats]:
    """The spots that each mark may choose, (n, L), the nearest first; and what they cost it, (n, L + 1), last
    that of no spot. L is how many are in reach of a mark at most, no more than `LABELS`."""
    away = np.abs(expected[:, :, None] - spots).min(axis=0)
    nearest = np.argsort(away, axis=1, kind="stable")[:, :LABELS]
    away = np.take_along_axis(away, nearest, axis=1)
    labels = int((away <= farthest).sum(axis=1).max())
    label, away = np.ascontiguousarray(nearest[:, :labels]), away[:, :labels]
    unary = np.full((len(label), labels + 1), MISSING_COST)
    cost = SURPRISE_COST * (away / pitch) ** 2 + FAINT_COST * np.maximum(1.0 - strength[label], 0.0)
    unary[:, :labels] = np.where(away > farthest, FORBIDDEN_COST, cost)
    return label, unary


def _own_best(links: _Links, spots: ComplexArray, label: Indices, unary: Floats) -> Indices | None:
    """What each mark chooses alone, if that is a smooth choice or there is none; else None.

    label, unary : of `_near_spots`; the costs of links to inliers are added to `unary`.
    """
    count, labels = label.shape
    if labels == 0:
        return np.full(count, -1, np.int64)
    moved = spots[label] - links.rest[links.free][:, None]
    _add_links_to_inliers(links, moved, unary)
    best, rows = np.argmin(unary, axis=1), np.arange(count)
    if (best == labels).any():
        return None
    own: Indices = label[rows, best]
    return own if len(np.unique(own)) == count and _is_smooth(links, moved[rows, best]) else None


def _add_links_to_inliers(links: _Links, moved: ComplexArray, unary: Floats) -> None:
    """Add to `unary`, (n, L + 1), what the links to inliers cost, whose displacement is not a matter of
    choice. moved : (n, L), displacement of each mark to each of its spots."""
    slot, inliers = links.slot, links.inliers
    one, other = links.edges.T
    there, back = (slot[one] >= 0) & inliers[other], (slot[other] >= 0) & inliers[one]
    mark = np.concatenate([slot[one][there], slot[other][back]])
    anchor = np.concatenate([other[there], one[back]])
    span = links.rest[anchor] - links.rest[links.free[mark]]
    change = (links.displacement[anchor][:, None] - moved[mark]) / span[:, None]
    squared = change.real**2 + change.imag**2
    costs = np.full((len(mark), unary.shape[1]), MISSING_LINK_COST)
    costs[:, :-1] = np.minimum(STRAIN_COST * squared, MOST_STRAIN_COST)
    costs[:, :-1] += FOLD_COST * (change.real < FOLD_STRAIN)
    np.add.at(unary, mark, costs)


def _is_smooth(links: _Links, moved: ComplexArray) -> bool:
    """Whether no link is strained if the free marks have moved so, (n,)."""
    slot, rest = links.slot, links.rest
    now, known = links.displacement.copy(), links.inliers.copy()
    now[links.free], known[links.free] = moved, True
    one, other = links.edges.T
    linked = known[one] & known[other] & ((slot[one] >= 0) | (slot[other] >= 0))
    one, other = one[linked], other[linked]
    return bool((np.abs(now[other] - now[one]) < SMOOTH_STRAIN * np.abs(rest[other] - rest[one])).all())


def _link_costs(links: _Links, spots: ComplexArray, label: Indices) -> tuple[Indices, Indices, Floats]:
    """First and second mark of each link between free marks; and what their labels, (n, L), cost together.

    Returns (links,), (links,) and (links, L + 1, L + 1); the last label is that of no spot.
    """
    labels = label.shape[1]
    inner = links.edges[(links.slot[links.edges] >= 0).all(axis=1)]
    first, second = links.slot[inner].T
    moved = spots[label] - links.rest[links.free][:, None]
    span = (links.rest[inner[:, 1]] - links.rest[inner[:, 0]])[:, None, None]
    change = (moved[second][:, None, :] - moved[first][:, :, None]) / span
    squared = change.real**2 + change.imag**2
    cost = np.minimum(STRAIN_COST * squared, MOST_STRAIN_COST) + FOLD_COST * (change.real < FOLD_STRAIN)
    pair = np.full((len(inner), labels + 1, labels + 1), MISSING_LINK_COST)
    pair[:, :labels, :labels] = cost + SHARED_COST * (label[first][:, :, None] == label[second][:, None, :])
    return first, second, pair


def _beliefs(unary: Floats, first: Indices, second: Indices, pair: Floats) -> Floats:
    """Costs of each mark's labels, (n, L + 1), by min-sum belief propagation; of all links at once.

    unary : (n, L + 1). first, second, pair : of `_link_costs`.
    """
    source, target = np.concatenate([first, second]), np.concatenate([second, first])
    cost = np.concatenate([pair, pair.transpose(0, 2, 1)])
    message = np.zeros((len(source), unary.shape[1]))
    belief, choice, unchanged = unary, unary.argmin(axis=1), 0
    for _ in range(MOST_ROUNDS if len(first) else 0):
        outgoing = belief[source] - np.roll(message, len(first), axis=0)
        fresh = (outgoing[:, :, None] + cost).min(axis=1)
        fresh -= fresh.min(axis=1, keepdims=True)
        message = (1 - DAMPING) * fresh + DAMPING * message
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
    choice, labels = belief.argmin(axis=1), label.shape[1]
    rows = np.arange(len(choice))
    chosen: Indices = np.where(choice < labels, label[rows, np.minimum(choice, labels - 1)], -1)
    surplus = belief[rows, choice] - belief[:, labels]
    taken: set[int] = set()
    for mark in np.argsort(surplus, kind="stable").tolist():
        spot = int(chosen[mark])
        if spot in taken:
            chosen[mark] = -1
        elif spot >= 0:
            taken.add(spot)
    return chosen
