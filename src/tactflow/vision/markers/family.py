"""Which spots of a picture are the marks: families of spots that are alike and form a lattice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats
from tactflow.vision.markers import lattice
from tactflow.vision.markers.lattice import LONGEST_LINK, Corners, nearest, neighbour_graph, pitch_of
from tactflow.vision.markers.likeness import likeness
from tactflow.vision.markers.scale_space import OVERLAP, RADIUS_PER_SIGMA, Spots, joined

Sign = Literal["dark", "bright"]

FAMILY_STRENGTH: Final = 0.35
"""Response of a mark over that of the typical one, at least. Chosen by hand: dirt and grain are a tail."""

BETWEEN: Final = 0.55
"""Distance, pitches, below which the weaker of two spots lies between marks. Chosen by hand."""

LONELY: Final = 2.3
"""Distance of the second nearest mark, pitches, beyond which a spot is lonely. Chosen by hand."""

RANDOM_SHARE: Final = 0.3
"""Share of parallelograms that close among spots in no lattice: 0.1 to 0.25 on rendered textures, 0.31 where
spots keep nearly the distance of a lattice from each other (measured)."""

LONG_LINK: Final = 1.8
"""Length of a link of the lattice, over the median one at either end, at most: longer ones lead to something
else. Chosen on tactip_video, whose pins have a bright rim around them."""

MOST_TESTED: Final = 500
"""Marks whose lattice is tested, those in the middle: bounds the time on a textured picture."""

MOST_SCALES: Final = 2.1
"""Radius of marks of one family over that of most of them, and its inverse, at most: painted marks and those
far off in perspective. Chosen on handmade_dots and sts_640."""

NEARLY_AS_STRONG: Final = 0.8
"""Response of a larger mark over that of a spot off its centre, at least. Chosen on handmade_dots."""

OFF_CENTRE: Final = 0.25
"""Distance from the centre of a mark, radii, from which on a spot is only a part of it. Chosen by hand."""

APART: Final = 0.9
"""Distance of two marks, sums of their radii, at least. Chosen by hand."""

ALONE: Final = 0.75
"""Clearance of a spot that needs no lattice to be a mark. Dots on even ground have 0.8 to 1, pieces of edges
and lines 0.3 to 0.7 (tactip_video, sts_640)."""

SAME_PLACE: Final = 0.5
"""Distance, radii, within which spots of two scales are one. Chosen by hand."""

SAME_SIZE: Final = 1.5
"""Ratio of two scales of which one spot may be, at most: two steps. Chosen by hand."""

CLEAR: Final = 0.55
"""Clearance of a spot that is a mark where a single corner or line of the lattice wants one. Chosen on
sts_640."""

ALIKE_STRENGTH: Final = (0.6, 1.7)
"""Response of such a spot, over that of most marks. Chosen by hand."""

NEAR_STRENGTH: Final = (0.3, 3.0)
"""Response of a spot where the lattice wants a mark, over that of the marks around. Chosen by hand: light and
dirt weaken marks."""

NEAR_RADIUS: Final = (0.65, 1.5)
"""Radius of such a spot, over those of the marks around. Chosen by hand."""

LEAST_BEND: Final = 0.15
"""Bend of a mark over that of most marks, at least: a piece of an edge or a line has 0. Of the dots marked on
18 sensors 0.2 loses 0.2 % more, and 0.1 takes a fifth more places for dots that are none."""

LEAST_SUPPORT: Final = 2
"""Corners and lines of the lattice that want a mark there, at least: one may be a coincidence."""

RING_CONTRAST: Final = 0.3
"""Clearance of a spot that is more than a piece of an edge, a line or a texture, at least. Chosen by hand."""

ALIKE: Final = 0.65
"""Likeness of a spot to the marks around, at least, to be one of them where the lattice wants one and other
marks are too near for the ring to tell. Chosen on pictures of eight sensors, shrunk until their marks were 3
to 8 px apart: 0.6 finds 0.5 % more of them and 0.2 % more that are none."""

MARKS_AROUND: Final = 4
"""Nearest marks that are compared with such a spot. Chosen by hand."""

MOST_ROUNDS: Final = 12
"""Rounds in which a lattice grows, a row each. Chosen by hand."""

SURE_SUPPORT: Final = 3
"""Corners and lines that want a mark where one is, to be beyond doubt. Chosen by hand."""

LEAST_CLUSTER: Final = 6
"""Marks of a lattice beside a larger one, at least: four or five spots form a parallelogram by chance
(sts_torque160)."""

MEMBER_SHARE: Final = 0.3
"""Share of closed parallelograms of a mark that is not alone, at least. Chosen on sts_640."""


class Family(NamedTuple):
    """Spots that look like the marks of one gel.

    score : how much so. share : of parallelograms of neighbours that close. sigma : scale, px.
    """

    score: float
    share: float
    sigma: float
    polarity: Sign
    spots: Spots


def families(scales: Mapping[Sign, Mapping[float, Spots]]) -> list[Family]:
    """The family of each polarity and scale that has one, the best first.

    scales : for each polarity and scale, px, its spots.
    """
    found = []
    for polarity, by_scale in scales.items():
        for sigma, spots in by_scale.items():
            members = _members(spots.at(spots.clear > RING_CONTRAST), sigma * RADIUS_PER_SIGMA)
            if len(members.points):
                middle = np.hypot(*(members.points - np.median(members.points, axis=0)).T)
                tested = members.points[np.argsort(middle, kind="stable")[:MOST_TESTED]]
                share = lattice.closed_share(tested, links(tested))
                # More contrast is evidence, but six lamps are no better than a hundred faint dots.
                total = float(np.median(members.strength)) * len(members.points)
                score = max(share - RANDOM_SHARE, 0.0) * total**0.5
                found.append(Family(score, share, sigma, polarity, members))
    return sorted(found, key=lambda family: (family.score, _total(family)), reverse=True)


def _total(family: Family) -> float:
    return float(family.spots.strength.sum())


def links(points: Floats) -> NDArray[np.int64]:
    """The neighbours (E, 2) among marks (N, 2)."""
    if len(points) < 2:
        return np.zeros((0, 2), np.int64)
    edges = neighbour_graph(points, LONGEST_LINK * pitch_of(points))
    length = np.hypot(*(points[edges[:, 0]] - points[edges[:, 1]]).T)
    usual = _median_of_links(edges, length, len(points))
    return np.asarray(edges[length < LONG_LINK * usual[edges].min(axis=1)], np.int64)


def _median_of_links(edges: NDArray[np.int64], values: Floats, count: int) -> Floats:
    """For each mark the (lower) median of the values (E,) of its links; infinity for a mark without."""
    mark, value = edges.T.ravel(), np.tile(values, 2)
    order = np.lexsort((value, mark))
    degree = np.bincount(mark, minlength=count)
    middle = np.cumsum(degree) - degree + (degree - 1) // 2
    return np.where(degree > 0, np.append(value[order], np.inf)[np.where(degree > 0, middle, -1)], np.inf)


def united(gray: NDArray[np.float32], family: Family, by_scale: Mapping[float, Spots]) -> Spots:
    """The marks of a family in all their sizes, without spots that only look like them.

    gray : (H, W) float32, grey levels. by_scale : the spots of the family's polarity.
    """
    scales = sorted(s for s in by_scale if 1 / MOST_SCALES <= s / family.sigma <= MOST_SCALES)
    least = NEAR_STRENGTH[0] * float(np.percentile(family.spots.strength, 10))
    strong = {s: by_scale[s].at(by_scale[s].strength > least) for s in scales}
    clear = {s: spots.at(spots.clear > RING_CONTRAST) for s, spots in strong.items()}
    crowded = joined(*(spots.at(spots.clear <= RING_CONTRAST) for spots in strong.values()))
    clearest = {s: _with_best_clearance(clear[s], s, clear) for s in scales}
    others = joined(*clearest.values())
    marks = _with_best_clearance(family.spots, family.sigma, clear)
    for sigma in scales:
        if sigma > family.sigma:
            marks = _with_larger(marks, clearest[sigma])
    marks = _with_alike(marks, others, family.sigma * RADIUS_PER_SIGMA)
    marks = _grown(gray, _supported(marks), others, crowded)
    return marks.at(marks.bend > LEAST_BEND * np.median(marks.bend)) if len(marks.points) else marks


def _members(spots: Spots, radius: float) -> Spots:
    """The spots of one scale that belong to one family of marks."""
    order = np.argsort(-spots.strength, kind="stable")
    if len(order) == 0:
        return spots
    # Strengths of marks are alike, those of dirt and grain are a tail: cut at a part of the typical one,
    # which is found from the top down so that the tail's length does not matter.
    ranked = spots.strength[order]
    typical = ranked[0]
    for _ in range(8):
        typical = float(np.median(ranked[ranked > FAMILY_STRENGTH * typical]))
    kept = spots.at(order[ranked > FAMILY_STRENGTH * typical])
    for _ in range(3):
        if len(kept.points) < 3:
            return kept
        distances, near = nearest(kept.points, min(4, len(kept.points) - 1))
        pitch = float(np.median(distances[:, 0]))
        between = (distances[:, 0] < BETWEEN * pitch) & (kept.strength < kept.strength[near[:, 0]])
        lonely = distances[:, min(1, distances.shape[1] - 1)] > LONELY * pitch
        if not (between | lonely).any():
            break
        kept = kept.at(~(between | lonely))
    # Evenly spaced spots that overlap are the ridges of a pattern.
    if len(kept.points) > 1 and pitch_of(kept.points) < OVERLAP * radius:
        return kept.at(np.zeros(0, np.int64))
    return kept


def _with_best_clearance(spots: Spots, sigma: float, scales: Mapping[float, Spots]) -> Spots:
    """The spots, each as clear as at the scale, of those next to its own, at which it is clearest."""
    best = spots.clear
    for other, found in scales.items():
        if 1 / SAME_SIZE < other / sigma < SAME_SIZE and len(found.points) and len(best):
            away, near = _nearest_of(found, spots)
            same = away < SAME_PLACE * spots.radius
            best = np.where(same, np.maximum(best, found.clear[near]), best)
    return spots._replace(clear=best)


def _nearest_of(spots: Spots, marks: Spots) -> tuple[Floats, NDArray[np.int64]]:
    """For each mark (N,) the distance, px, and the number of the nearest of the spots, of which there are."""
    here, there = (np.ascontiguousarray(part.points, np.float32) for part in (marks, spots))
    away, near = cv2.batchDistance(here, there, cv2.CV_32F, None, None, cv2.NORM_L2, 1)
    return np.asarray(away[:, 0], np.float64), np.asarray(near[:, 0], np.int64)


def _with_larger(marks: Spots, larger: Spots) -> Spots:
    """Spots of a larger scale in the place of those that they cover."""
    away = _distances(larger.points, marks.points)
    kept, taken = np.ones(len(marks.points), bool), np.zeros(len(larger.points), bool)
    for n in range(len(larger.points)):
        covered = kept & (away[n] < larger.radius[n])
        touched = kept & (away[n] < larger.radius[n] + APART * marks.radius)
        if not covered.any() or (touched & ~covered).any():
            continue
        off = away[n][covered] > OFF_CENTRE * marks.radius[covered]
        needed = marks.strength[covered] * np.where(off, NEARLY_AS_STRONG, 1.0)
        if larger.strength[n] > needed.max():
            kept[covered], taken[n] = False, True
    return joined(marks.at(kept), larger.at(taken))


def _with_alike(marks: Spots, others: Spots, radius: float) -> Spots:
    """Also spots, not smaller, that stand alone and are as strong as the marks."""
    if len(marks.points) < 2:
        return marks
    pitch, typical = pitch_of(marks.points), float(np.median(marks.strength))
    fits = (others.clear > ALONE) & (others.radius > 0.99 * radius)
    fits &= (others.strength > ALIKE_STRENGTH[0] * typical) & (others.strength < ALIKE_STRENGTH[1] * typical)
    alike = _free(others.at(fits), marks)
    near = np.sort(_distances(alike.points, marks.points), axis=1)[:, :2]
    alike = alike.at(np.flatnonzero((near[:, 0] > BETWEEN * pitch) & (near[:, 1] < LONELY * pitch)))
    return joined(marks, _apart(alike, alike.strength))


def _grown(gray: NDArray[np.float32], marks: Spots, others: Spots, crowded: Spots) -> Spots:
    """Also spots where the lattice wants a mark, if they are like the marks around.

    crowded : spots that do not differ from all of the ring around them, be it that it meets other marks.
    """
    for _ in range(MOST_ROUNDS):
        if len(marks.points) < MARKS_AROUND:
            break
        others, crowded = _free(others, marks), _free(crowded, marks)
        new = _wanted(gray, marks, others)
        if len(new.points) == 0:
            new = _wanted(gray, marks, joined(others, crowded))
        if len(new.points) == 0:
            break
        marks = joined(marks, new)
    return marks


def _wanted(gray: NDArray[np.float32], marks: Spots, spots: Spots) -> Spots:
    """Of spots that touch no mark, those that go on with the lattice and are like the marks around."""
    support = lattice.support(spots.points, _expected(marks.points))
    wanted, support = spots.at(support > 0), support[support > 0]
    away = _distances(wanted.points, marks.points)
    around = np.argsort(away, axis=1, kind="stable")[:, :MARKS_AROUND]
    usual = np.median(marks.radius[around], axis=1)
    radius = wanted.radius / usual
    strength = wanted.strength / np.median(marks.strength[around], axis=1)
    bend = np.median(marks.bend[around], axis=1)
    fits = (wanted.bend > LEAST_BEND * bend) & (radius > NEAR_RADIUS[0]) & (radius < NEAR_RADIUS[1])
    fits &= (strength > NEAR_STRENGTH[0]) & (strength < NEAR_STRENGTH[1])
    sure = (wanted.clear > CLEAR) & (strength > ALIKE_STRENGTH[0]) & (strength < ALIKE_STRENGTH[1])
    chosen = (wanted.clear > RING_CONTRAST) & ((support >= LEAST_SUPPORT) | sure)
    left = np.flatnonzero(fits & ~chosen)
    chosen[left] = likeness(gray, wanted.points[left], marks.points[around[left]], usual[left]) > ALIKE
    rank = wanted.strength * np.minimum(radius, 1 / radius)
    return _apart(wanted.at(fits & chosen), rank[fits & chosen])


def _expected(points: Floats) -> Corners:
    """Where the lattice wants marks: the corners of parallelograms, and the next place along each line."""
    edges = links(points)
    found = lattice.corners(points, edges)
    first, last = np.concatenate([edges, edges[:, ::-1]]).T
    step = points[last] - points[first]
    reach = lattice.CLOSED * np.hypot(*step.T)
    return Corners(
        np.concatenate([found.points, points[last] + step]),
        np.concatenate([found.reach, reach]),
        np.concatenate([found.first, first]),
        np.concatenate([found.middle, last]),
        np.concatenate([found.last, last]),
    )


def _supported(marks: Spots) -> Spots:
    """The marks that are part of a lattice, or stand alone beside one."""
    for _ in range(3):
        if len(marks.points) < 4:
            break
        edges = links(marks.points)
        share, cluster = lattice.own_shares(marks.points, edges)
        lattices = cluster >= min(LEAST_CLUSTER, cluster.max())
        member = lattices & (share >= MEMBER_SHARE)
        support = lattice.others_support(marks.points, _expected(marks.points))
        strong = marks.strength > ALIKE_STRENGTH[0] * np.median(marks.strength)
        away = _distances(marks.points, marks.points[lattices]).min(axis=1)
        beside = away < LONELY * pitch_of(marks.points)
        alone = (marks.clear > ALONE) & (strong | (support > 0)) & beside
        kept = member | alone | (support >= SURE_SUPPORT)
        if kept.all():
            break
        marks = marks.at(kept)
    return marks


def _free(spots: Spots, marks: Spots) -> Spots:
    """The spots that touch no mark."""
    away = _distances(spots.points, marks.points)
    touching = away <= APART * (spots.radius[:, None] + marks.radius)
    return spots.at(np.flatnonzero(~touching.any(axis=1)))


def _apart(spots: Spots, rank: Floats) -> Spots:
    """Of spots that touch each other, the one of the highest rank."""
    left = np.ones(len(rank), bool)
    kept = []
    for n in np.argsort(-rank, kind="stable"):
        if left[n]:
            kept.append(n)
            away = np.hypot(*(spots.points - spots.points[n]).T)
            left &= away > APART * (spots.radius + spots.radius[n])
    return spots.at(np.array(kept, np.int64))


def _distances(points: Floats, others: Floats) -> Floats:
    """(n, N) distances, px."""
    x = points[:, :1] - others[:, 0]
    y = points[:, 1:] - others[:, 1]
    return np.asarray(np.sqrt(x * x + y * y), np.float64)
