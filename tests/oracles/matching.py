"""Plain version of the kernel that chooses spots for marks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers import matching
from tactflow.vision.markers.matching import propagate_beliefs
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]


def _complex(points: FloatArray) -> ComplexArray:
    """x + i y, which makes lengths and inner products of many pairs cheap."""
    return np.asarray(points[..., 0] + 1j * points[..., 1], np.complex128)


def _link_cost(first: ComplexArray, second: ComplexArray, span: ComplexArray) -> FloatArray:
    """Cost of two displacements of neighbours that are `span` apart in the reference."""
    change = (second - first) / span
    squared = change.real**2 + change.imag**2
    cost = np.minimum(matching.STRAIN_COST * squared, matching.MOST_STRAIN_COST)
    return np.asarray(cost + matching.FOLD_COST * (change.real < matching.FOLD_STRAIN), np.float64)


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


GAINS = [Gain(propagate_beliefs, plain_propagate_beliefs)]
