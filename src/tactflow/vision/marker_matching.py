"""Which spot of a frame is which mark: a joint choice, so that neighbours move alike."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Costs, in units where neighbours that differ by half their distance cost 0.5: of not seeing a mark, of each
# of its links then, and of a displacement one pitch away from what was expected.
_MISSING: Final = 1.0
_MISSING_LINK: Final = 0.25
_SURPRISE: Final = 0.25
_STRETCH: Final = 2.0
_WORST_STRETCH: Final = 1.2
_FOLD: Final = 1.0
_SHARED: Final = 4.0
_FORBIDDEN: Final = 1e3
_LABELS: Final = 8
# Where everybody's own best spot stretches no link by more than this, the own best is the joint best.
_SMOOTH: Final = 0.35


def choose_spots(
    origin: FloatArray,
    edges: IntArray,
    free: IntArray,
    settled: BoolArray,
    displacement: FloatArray,
    expected: FloatArray,
    spots: FloatArray,
    strength: FloatArray,
    *,
    pitch: float,
    farthest: float,
) -> IntArray:
    """Give each free mark one of the spots, or none.

    The choice minimises the sum of: how much each link between neighbours is stretched, squared and bounded,
    with a fine for folding; how far each mark goes from where it is expected; faint spots; marks without a
    spot. Marks that are settled take part through their links. Where the own best of every mark is not smooth
    already, the minimum is sought by min-sum belief propagation, whose cost grows with the number of free
    marks.

    Parameters
    ----------
    origin : (N, 2) float64, marks in the reference, px. edges : (E, 2) int64, neighbours.
    free : (n,) int64, marks that choose. settled : (N,) bool, marks whose displacement is known.
    displacement : (N, 2) float64, px, valid where settled.
    expected : (k, n, 2) float64, k opinions where the free marks may be, px; the nearest one counts.
    spots : (M, 2) float64, px. strength : (M,) float64, 1 for a typical mark, less for faint ones.
    pitch : px. farthest : a spot no farther than this from what is expected may be chosen, px.

    Returns
    -------
    chosen : (n,) int64, number of the spot, -1 for none. No spot is chosen twice.

    References
    ----------
    Pearl, "Probabilistic reasoning in intelligent systems" (1988); Felzenszwalb and Huttenlocher, "Efficient
    belief propagation for early vision", IJCV 70 (2006).
    """
    count = len(free)
    chosen = np.full(count, -1, np.int64)
    if count == 0 or len(spots) == 0:
        return chosen
    rest, place = _complex(origin), _complex(spots)
    away = np.abs(_complex(expected)[:, :, None] - place).min(axis=0)
    labels = min(_LABELS, int((away <= farthest).sum(axis=1).max()))
    if labels == 0:
        return chosen
    label = np.argsort(away, axis=1, kind="stable")[:, :labels]
    away = np.take_along_axis(away, label, axis=1)
    moved = place[label] - rest[free][:, None]
    unary = np.full((count, labels + 1), _MISSING)
    unary[:, :labels] = _SURPRISE * (away / pitch) ** 2 + 0.4 * np.maximum(1.0 - strength[label], 0.0)
    unary[:, :labels][away > farthest] = _FORBIDDEN

    slot = np.full(len(origin), -1, np.int64)
    slot[free] = np.arange(count)
    ends = slot[edges]
    smooth = True
    # Settled neighbours pull each mark on their own.
    shift = _complex(displacement)
    anchored = [
        (ends[pulled, one], edges[pulled, other])
        for one, other in ((0, 1), (1, 0))
        for pulled in ((ends[:, one] >= 0) & settled[edges[:, other]],)
    ]
    mark = np.concatenate([pair[0] for pair in anchored])
    anchor = np.concatenate([pair[1] for pair in anchored])
    if len(mark):
        cost = np.full((len(mark), labels + 1), _MISSING_LINK)
        span = rest[anchor] - rest[free[mark]]
        cost[:, :labels] = _disagreement(moved[mark], shift[anchor][:, None], span[:, None])
        np.add.at(unary, mark, cost)

    own = np.argmin(unary, axis=1)
    inner = np.flatnonzero((ends >= 0).all(axis=1))
    first, second = ends[inner, 0], ends[inner, 1]
    span = rest[free[second]] - rest[free[first]]
    smooth = bool((own < labels).all())
    if smooth:
        rows = np.arange(count)
        own_spot, own_move = label[rows, own], moved[rows, own]
        smooth = len(set(own_spot.tolist())) == count
        smooth = smooth and bool((np.abs(own_move[second] - own_move[first]) < _SMOOTH * np.abs(span)).all())
        if smooth and len(mark):
            stretch = np.abs(own_move[mark] - shift[anchor])
            smooth = bool((stretch < _SMOOTH * np.abs(rest[anchor] - rest[free[mark]])).all())
        if smooth:
            return np.asarray(own_spot, np.int64)
    belief = unary
    if len(inner):
        pair = np.full((len(inner), labels + 1, labels + 1), _MISSING_LINK)
        pair[:, :labels, :labels] = _disagreement(
            moved[first][:, :, None], moved[second][:, None, :], span[:, None, None]
        )
        pair[:, :labels, :labels] += _SHARED * (label[first][:, :, None] == label[second][:, None, :])
        belief = _propagate(unary, first, second, pair)
    return _decide(belief, label)


def _decide(belief: FloatArray, label: IntArray) -> IntArray:
    """The cheapest label of each mark; of two marks that want one spot, the surer one gets it."""
    count, labels = label.shape
    choice = np.argmin(belief, axis=1)
    rows = np.arange(count)
    chosen = np.where(choice < labels, label[rows, np.minimum(choice, labels - 1)], -1)
    surplus = belief[rows, choice] - belief[:, labels]
    used: set[int] = set()
    for mark in np.argsort(surplus, kind="stable").tolist():
        spot = int(chosen[mark])
        if spot in used:
            chosen[mark] = -1
        elif spot >= 0:
            used.add(spot)
    return np.asarray(chosen, np.int64)


def _complex(points: FloatArray) -> ComplexArray:
    """x + i y, which makes lengths and inner products of many pairs cheap."""
    return np.asarray(points[..., 0] + 1j * points[..., 1], np.complex128)


def _disagreement(first: ComplexArray, second: ComplexArray, span: ComplexArray) -> FloatArray:
    """Cost of two displacements of neighbours that are `span` apart in the reference."""
    # In units of the span: 0 for a common motion; a real part below -0.75 brings one on top of the other.
    change = (second - first) / span
    cost = np.minimum(_STRETCH * (change.real**2 + change.imag**2), _WORST_STRETCH)
    cost += _FOLD * (change.real < -0.75)
    return np.asarray(cost, np.float64)


def _propagate(unary: FloatArray, first: IntArray, second: IntArray, pair: NDArray[Any]) -> FloatArray:
    """Min-sum belief propagation: (n, L) costs, links with (L, L) costs each -> (n, L) beliefs (costs)."""
    source = np.concatenate([first, second])
    links = len(first)
    reverse = np.concatenate([np.arange(links) + links, np.arange(links)])
    # Axes: the label of the sender, the link, the label of the receiver: a minimum over the first is fastest.
    cost = np.concatenate([pair.transpose(1, 0, 2), pair.transpose(2, 0, 1)], axis=1)
    collect = np.zeros((len(unary), 2 * links))
    collect[source[reverse], np.arange(2 * links)] = 1.0
    message = np.zeros((2 * links, unary.shape[1]))
    belief = unary
    choice = np.argmin(belief, axis=1)
    unchanged = 0
    for _ in range(24):
        outgoing = belief[source] - message[reverse]
        fresh = (outgoing.T[:, :, None] + cost).min(axis=0)
        fresh -= fresh.min(axis=1, keepdims=True)
        # Damping keeps messages around loops from oscillating.
        message = 0.7 * fresh + 0.3 * message
        belief = unary + collect @ message
        latest = np.argmin(belief, axis=1)
        unchanged = unchanged + 1 if np.array_equal(latest, choice) else 0
        if unchanged == 3:
            break
        choice = latest
    return belief
