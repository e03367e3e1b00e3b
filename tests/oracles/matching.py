"""Plain versions of the kernels that choose spots for marks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers import matching
from tactflow.vision.markers.matching import propagate_beliefs, unary_costs
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def _complex(points: FloatArray) -> ComplexArray:
    """x + i y, which makes lengths and inner products of many pairs cheap."""
    return np.asarray(points[..., 0] + 1j * points[..., 1], np.complex128)


def _link_cost(first: ComplexArray, second: ComplexArray, span: ComplexArray) -> FloatArray:
    """Cost of two displacements of neighbours that are `span` apart in the reference."""
    change = (second - first) / span
    squared = change.real**2 + change.imag**2
    cost = np.minimum(matching.STRAIN_COST * squared, matching.MOST_STRAIN_COST)
    return np.asarray(cost + matching.FOLD_COST * (change.real < matching.FOLD_STRAIN), np.float64)


def plain_unary_costs(
    origin: FloatArray,
    edges: IntArray,
    free: IntArray,
    inliers: BoolArray,
    displacement: FloatArray,
    expected: FloatArray,
    spots: FloatArray,
    strength: FloatArray,
    pitch: float,
    farthest: float,
    slot: IntArray,
    label: IntArray,
    unary: FloatArray,
    chosen: IntArray,
) -> int:
    """All marks, spots and links at once, in complex numbers."""
    count = len(free)
    slot[:] = -1
    slot[free] = np.arange(count)
    rest, place, shift = _complex(origin), _complex(spots), _complex(displacement)
    away = np.abs(_complex(expected)[:, :, None] - place).min(axis=0)
    most = min(matching.LABELS, len(spots))
    label[:, :most] = np.argsort(away, axis=1, kind="stable")[:, :most]
    labels = min(most, int((away <= farthest).sum(axis=1).max()))
    if labels == 0:
        return 0
    near = label[:, :labels]
    away = np.take_along_axis(away, near, axis=1)
    cost = matching.SURPRISE_COST * (away / pitch) ** 2
    cost += matching.FAINT_COST * np.maximum(1.0 - strength[near], 0.0)
    unary[:, :labels] = np.where(away > farthest, matching.FORBIDDEN_COST, cost)
    unary[:, labels] = matching.MISSING_COST
    moved = place[near] - rest[free][:, None]
    one, other = edges.T
    there, back = (slot[one] >= 0) & inliers[other], (slot[other] >= 0) & inliers[one]
    mark = np.concatenate([slot[one][there], slot[other][back]])
    anchor = np.concatenate([other[there], one[back]])
    span = rest[anchor] - rest[free[mark]]
    links = np.full((len(mark), labels + 1), matching.MISSING_LINK_COST)
    links[:, :labels] = _link_cost(moved[mark], shift[anchor][:, None], span[:, None])
    np.add.at(unary[:, : labels + 1], mark, links)

    best = np.argmin(unary[:, : labels + 1], axis=1)
    if (best == labels).any():
        return labels
    own = near[np.arange(count), best]
    if len(np.unique(own)) < count:
        return labels
    now, known = shift.copy(), inliers.copy()
    now[free], known[free] = place[own] - rest[free], True
    linked = known[one] & known[other] & ((slot[one] >= 0) | (slot[other] >= 0))
    one, other = one[linked], other[linked]
    if not (np.abs(now[other] - now[one]) < matching.SMOOTH_STRAIN * np.abs(rest[other] - rest[one])).all():
        return labels
    chosen[:] = own
    return 0


def plain_propagate_beliefs(
    origin: FloatArray,
    edges: IntArray,
    free: IntArray,
    slot: IntArray,
    spots: FloatArray,
    label: IntArray,
    unary: FloatArray,
    labels: int,
    chosen: IntArray,
) -> None:
    """Messages of all links at once."""
    label, unary = label[:, :labels], unary[:, : labels + 1]
    inner = edges[(slot[edges] >= 0).all(axis=1)]
    first, second = slot[inner].T
    rest = _complex(origin)
    moved = _complex(spots)[label] - rest[free][:, None]
    span = (rest[inner[:, 1]] - rest[inner[:, 0]])[:, None, None]
    pair = np.full((len(inner), labels + 1, labels + 1), matching.MISSING_LINK_COST)
    pair[:, :labels, :labels] = _link_cost(moved[first][:, :, None], moved[second][:, None, :], span)
    pair[:, :labels, :labels] += matching.SHARED_COST * (
        label[first][:, :, None] == label[second][:, None, :]
    )
    belief = _propagate(unary, first, second, pair) if len(inner) else unary
    choice = np.argmin(belief, axis=1)
    rows = np.arange(len(free))
    chosen[:] = np.where(choice < labels, label[rows, np.minimum(choice, labels - 1)], -1)
    surplus = belief[rows, choice] - belief[:, labels]
    used: set[int] = set()
    for mark in np.argsort(surplus, kind="stable").tolist():
        spot = int(chosen[mark])
        if spot in used:
            chosen[mark] = -1
        elif spot >= 0:
            used.add(spot)


def _propagate(unary: FloatArray, first: IntArray, second: IntArray, pair: FloatArray) -> FloatArray:
    """Min-sum belief propagation: (n, L) costs, links with (L, L) costs each -> (n, L) beliefs (costs)."""
    links = len(first)
    source, target = np.concatenate([first, second]), np.concatenate([second, first])
    cost = np.concatenate([pair, pair.transpose(0, 2, 1)])
    message = np.zeros((2 * links, unary.shape[1]))
    belief = unary
    choice, unchanged = belief.argmin(axis=1), 0
    for _ in range(matching.MOST_ROUNDS):
        outgoing = belief[source] - np.roll(message, links, axis=0)
        fresh = (outgoing[:, :, None] + cost).min(axis=1)
        fresh -= fresh.min(axis=1, keepdims=True)
        message = (1 - matching.DAMPING) * fresh + matching.DAMPING * message
        belief = unary.copy()
        np.add.at(belief, target, message)
        latest = belief.argmin(axis=1)
        unchanged = unchanged + 1 if (latest == choice).all() else 0
        if unchanged == matching.STABLE_ROUNDS:
            break
        choice = latest
    return belief


GAINS = [
    # Where marks do not find a smooth choice, the kernel has begun to write down the one it gave up.
    Gain(unary_costs, plain_unary_costs, tolerance=1e-9, scratch=("chosen",)),
    Gain(propagate_beliefs, plain_propagate_beliefs),
]
