"""Which spot of a frame is which mark: a joint choice, so that neighbours move alike."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled

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
# Propagation ends when the best labels did not change so many times in a row, or after so many rounds.
# Damping keeps messages around loops from oscillating.
_CALM: Final = 3
_MOST_ROUNDS: Final = 24
_DAMPING: Final = 0.3


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
    if compiled.active():
        origin = np.ascontiguousarray(origin, np.float64)
        edges = np.ascontiguousarray(edges, np.int64)
        free = np.ascontiguousarray(free, np.int64)
        spots = np.ascontiguousarray(spots, np.float64)
        slot = np.empty(len(origin), np.int64)
        label, unary = np.empty((count, _LABELS), np.int64), np.empty((count, _LABELS + 1))
        labels = propose(
            origin,
            edges,
            free,
            np.ascontiguousarray(settled, np.bool_),
            np.ascontiguousarray(displacement, np.float64),
            np.ascontiguousarray(expected, np.float64),
            spots,
            np.ascontiguousarray(strength, np.float64),
            pitch,
            farthest,
            slot,
            label,
            unary,
            chosen,
        )
        if labels < 0:
            raise IndexError(f"required marks 0 to {len(origin) - 1} in edges and free, got others")
        if labels > 0:
            agree(origin, edges, free, slot, spots, label, unary, labels, chosen)
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
    # Settled neighbours pull each mark on their own.
    shift = _complex(displacement)
    one, other = edges[:, 0], edges[:, 1]
    first, second = slot[one], slot[other]
    starts, stops = first >= 0, second >= 0
    there, back = np.flatnonzero(starts & settled[other]), np.flatnonzero(stops & settled[one])
    mark = np.concatenate([first[there], second[back]])
    anchor = np.concatenate([other[there], one[back]])
    if len(mark):
        cost = np.full((len(mark), labels + 1), _MISSING_LINK)
        span = rest[anchor] - rest[free[mark]]
        cost[:, :labels] = _disagreement(moved[mark], shift[anchor][:, None], span[:, None])
        np.add.at(unary, mark, cost)

    own = np.argmin(unary, axis=1)
    inner = np.flatnonzero(starts & stops)
    first, second = first[inner], second[inner]
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
    links, labels = len(first), unary.shape[1]
    source, target = np.concatenate([first, second]), np.concatenate([second, first])
    # Axes: the label of the sender, that of the receiver, the link there and back: longest last is fastest.
    cost = np.concatenate([pair.transpose(1, 2, 0), pair.transpose(2, 1, 0)], axis=2)
    collect = np.zeros((2 * links, len(unary)))
    collect[np.arange(2 * links), target] = 1.0
    message = np.zeros((labels, 2 * links))
    own = np.ascontiguousarray(unary.T)
    belief = own
    choice = belief.argmin(axis=0)
    unchanged = 0
    for _ in range(_MOST_ROUNDS):
        back = message.reshape(labels, 2, links)[:, ::-1].reshape(labels, 2 * links)
        outgoing = belief.take(source, axis=1) - back
        fresh = (outgoing[:, None] + cost).min(axis=0)
        fresh -= fresh.min(axis=0)
        message = (1 - _DAMPING) * fresh + _DAMPING * message
        belief = own + message @ collect
        latest = belief.argmin(axis=0)
        unchanged = unchanged + 1 if (latest == choice).all() else 0
        if unchanged == _CALM:
            break
        choice = latest
    return np.ascontiguousarray(belief.T)


@compiled.kernel(
    "int64(float64[:, ::1], int64[:, ::1], int64[::1], boolean[::1], float64[:, ::1], float64[:, :, ::1],"
    "float64[:, ::1], float64[::1], float64, float64, int64[::1], int64[:, ::1], float64[:, ::1], int64[::1])"
)
def propose(
    origin: FloatArray,
    edges: IntArray,
    free: IntArray,
    settled: BoolArray,
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
    """The first half of `choose_spots`: the spots that each mark may choose and what they cost it alone.

    Into `slot` (N,), the number of each mark among the free ones or -1; `label` (n, 8), the nearest spots;
    `unary` (n, 9), their costs, and last that of no spot. Returns the number of labels, or 0 where nothing is
    left to do: nothing is in reach, or everybody's best, now in `chosen`, is smooth; or -1 where `edges` or
    `free` name marks that there are not.
    """
    count, opinions = len(free), len(expected)
    for e in range(len(edges)):
        if min(edges[e, 0], edges[e, 1]) < 0 or max(edges[e, 0], edges[e, 1]) >= len(origin):
            return -1
    for n in range(count):
        if free[n] < 0 or free[n] >= len(origin):
            return -1
    most = min(_LABELS, len(spots))
    away = np.empty((count, _LABELS))
    slot[:] = -1
    labels = 0
    for n in range(count):
        slot[free[n]] = n
        filled = within = 0
        for spot in range(len(spots)):
            squared = np.inf
            for k in range(opinions):
                away_x, away_y = expected[k, n, 0] - spots[spot, 0], expected[k, n, 1] - spots[spot, 1]
                squared = min(squared, away_x * away_x + away_y * away_y)
            if filled == most and squared >= away[n, most - 1]:
                continue
            place = filled if filled < most else most - 1
            while place > 0 and away[n, place - 1] > squared:
                away[n, place], label[n, place] = away[n, place - 1], label[n, place - 1]
                place -= 1
            away[n, place], label[n, place] = squared, spot
            filled = min(filled + 1, most)
        for place in range(most):
            away[n, place] = np.sqrt(away[n, place])
            within += away[n, place] <= farthest
        labels = max(labels, within)
    if labels == 0:
        return 0
    for n in range(count):
        for k in range(labels):
            cost = away[n, k] / pitch
            unary[n, k] = _SURPRISE * (cost * cost) + 0.4 * max(1.0 - strength[label[n, k]], 0.0)
            if away[n, k] > farthest:
                unary[n, k] = _FORBIDDEN
        unary[n, labels] = _MISSING
    for one in range(2):
        for e in range(len(edges)):
            n, anchor = slot[edges[e, one]], edges[e, 1 - one]
            if n < 0 or not settled[anchor]:
                continue
            mark = free[n]
            span_x, span_y = origin[anchor, 0] - origin[mark, 0], origin[anchor, 1] - origin[mark, 1]
            scale = 1.0 / (span_x * span_x + span_y * span_y)
            for k in range(labels):
                change_x = displacement[anchor, 0] - (spots[label[n, k], 0] - origin[mark, 0])
                change_y = displacement[anchor, 1] - (spots[label[n, k], 1] - origin[mark, 1])
                stretch = (change_x * change_x + change_y * change_y) * scale
                unary[n, k] += min(_STRETCH * stretch, _WORST_STRETCH)
                if (change_x * span_x + change_y * span_y) * scale < -0.75:
                    unary[n, k] += _FOLD
            unary[n, labels] += _MISSING_LINK
    taken = np.zeros(len(spots), np.bool_)
    for n in range(count):
        own = np.argmin(unary[n, : labels + 1])
        if own == labels or taken[label[n, own]]:
            return labels
        chosen[n] = label[n, own]
        taken[label[n, own]] = True
    for e in range(len(edges)):
        one, other = edges[e, 0], edges[e, 1]
        first, second = slot[one], slot[other]
        if not ((first >= 0 or settled[one]) and (second >= 0 or settled[other])) or max(first, second) < 0:
            continue
        span_x, span_y = origin[other, 0] - origin[one, 0], origin[other, 1] - origin[one, 1]
        change_x = displacement[other, 0] if second < 0 else spots[chosen[second], 0] - origin[other, 0]
        change_y = displacement[other, 1] if second < 0 else spots[chosen[second], 1] - origin[other, 1]
        change_x -= displacement[one, 0] if first < 0 else spots[chosen[first], 0] - origin[one, 0]
        change_y -= displacement[one, 1] if first < 0 else spots[chosen[first], 1] - origin[one, 1]
        if not np.hypot(change_x, change_y) < _SMOOTH * np.hypot(span_x, span_y):
            return labels
    return 0


@compiled.kernel(
    "void(float64[:, ::1], int64[:, ::1], int64[::1], int64[::1], float64[:, ::1], int64[:, ::1],"
    "float64[:, ::1], int64, int64[::1])"
)
def agree(
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
    """The second half of `choose_spots`, of what `propose` gave: propagation and decision, into `chosen`."""
    count, states, links = len(free), labels + 1, 0
    for e in range(len(edges)):
        links += slot[edges[e, 0]] >= 0 and slot[edges[e, 1]] >= 0
    # Link by link, there and back: who sends to whom, and what its label costs with the receiver's.
    source, target = np.empty(2 * links, np.int64), np.empty(2 * links, np.int64)
    pair = np.full((2 * links, states, states), _MISSING_LINK)
    link = 0
    for e in range(len(edges)):
        one, other = edges[e, 0], edges[e, 1]
        first, second = slot[one], slot[other]
        if first < 0 or second < 0:
            continue
        source[link], target[link], source[link + 1], target[link + 1] = first, second, second, first
        span_x, span_y = origin[other, 0] - origin[one, 0], origin[other, 1] - origin[one, 1]
        scale = 1.0 / (span_x * span_x + span_y * span_y)
        for k in range(labels):
            here = label[first, k]
            for m in range(labels):
                there = label[second, m]
                change_x = (spots[there, 0] - origin[other, 0]) - (spots[here, 0] - origin[one, 0])
                change_y = (spots[there, 1] - origin[other, 1]) - (spots[here, 1] - origin[one, 1])
                stretch = (change_x * change_x + change_y * change_y) * scale
                cost = min(_STRETCH * stretch, _WORST_STRETCH)
                if (change_x * span_x + change_y * span_y) * scale < -0.75:
                    cost += _FOLD
                if here == there:
                    cost += _SHARED
                pair[link, k, m] = pair[link + 1, m, k] = cost
        link += 2
    message = np.zeros((2 * links, states))
    latest = np.empty((2 * links, states))
    belief = unary[:, :states].copy()
    total = np.empty((count, states))
    choice = np.empty(count, np.int64)
    for n in range(count):
        choice[n] = np.argmin(belief[n])
    unchanged = 0
    for _ in range(_MOST_ROUNDS if links else 0):
        total[:] = 0.0
        for link in range(2 * links):
            fresh = latest[link]
            fresh[:] = np.inf
            for k in range(states):
                # The way back is the other of the two.
                outgoing = belief[source[link], k] - message[link ^ 1, k]
                for m in range(states):
                    fresh[m] = min(fresh[m], outgoing + pair[link, k, m])
            least = fresh[0]
            for m in range(1, states):
                least = min(least, fresh[m])
            for m in range(states):
                fresh[m] = (1 - _DAMPING) * (fresh[m] - least) + _DAMPING * message[link, m]
                total[target[link], m] += fresh[m]
        message, latest = latest, message
        same = True
        for n in range(count):
            for m in range(states):
                belief[n, m] = unary[n, m] + total[n, m]
            best = np.argmin(belief[n])
            same = same and best == choice[n]
            choice[n] = best
        unchanged = unchanged + 1 if same else 0
        if unchanged == _CALM:
            break
    # Of two marks that want one spot, the surer one gets it.
    owner = np.full(len(spots), -1, np.int64)
    surplus = np.empty(count)
    chosen[:] = -1
    for n in range(count):
        surplus[n] = belief[n, choice[n]] - belief[n, labels]
        if choice[n] == labels:
            continue
        spot = label[n, choice[n]]
        rival = owner[spot]
        if rival >= 0:
            if surplus[rival] <= surplus[n]:
                continue
            chosen[rival] = -1
        owner[spot], chosen[n] = n, spot
