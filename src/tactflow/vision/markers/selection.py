"""Select the spots of a picture that are marks: those that are alike and form a lattice.

The spots of one scale and polarity with the most contrast in the best lattice come first. Spots of other
scales, and crowded ones, are added where the lattice predicts a mark and they look like the marks around.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tactflow.vision.arrays import Floats
from tactflow.vision.markers.lattice import MAX_LINK_PITCHES, NEIGHBOUR_COUNT, Lattice, nearest, support
from tactflow.vision.markers.spots import RADIUS_PER_SIGMA, Spots, joined

Polarity = Literal["dark", "bright"]

MIN_STRENGTH_RATIO: Final = 0.35
"""Minimum response of a mark, relative to the typical one of its scale: dirt and grain are a tail. With 0.25,
grain between marks that are 3 px apart takes their places (sts_torque160)."""

MIN_SPACING_PITCHES: Final = 0.55
"""Distance, pitches, below which the weaker of two spots lies between marks. Chosen by hand."""

RANDOM_CLOSED_SHARE: Final = 0.3
"""Share of closed parallelograms without a lattice: 0.1 to 0.25 on rendered textures, 0.31 for spots that
keep nearly the distance of a lattice from each other (measured)."""

MIN_SPACING_RADII: Final = 0.9
"""Minimum distance of two marks, in sums of their radii: with 1, crowded marks are lost (sts_torque160)."""

ISOLATED_CLEARANCE: Final = 0.65
"""Minimum clearance of a mark that little else supports: an isolated one, or one that a single corner or line
of the lattice predicts. Dots on an even background have 0.8 to 1, pieces of edges and lines 0.3 to 0.7
(tactip_video, sts_640)."""

MAX_STRENGTH_RATIO: Final = 3.2
"""Maximum ratio of the responses of a spot and of the marks around, either way, where the lattice predicts a
mark: uneven light and dirt weaken marks."""

MAX_LOST_SPOTS: Final = 1
"""Maximum number of spots of a candidate that a finer scale of the same marks lacks: a scrap beside them."""

MAX_SIZE_RATIO: Final = 1.5
"""Maximum ratio of the radii of a spot and of the marks around, either way; and of their responses, where
only clearance supports it."""

MIN_BEND_RATIO: Final = 0.15
"""Minimum bend of a mark, relative to the median: a piece of an edge or a line has 0. With 0.2, 0.2 % more of
the dots labelled on 18 sensors are lost; with 0.1, there are a fifth more false dots."""

MIN_SUPPORT: Final = 2
"""Minimum number of corners and lines of the lattice that predict a mark: one may be a coincidence."""

MIN_CLEARANCE: Final = 0.3
"""Minimum clearance of a spot: pieces of edges, lines and textures have less. Chosen by hand."""

MIN_LIKENESS: Final = 0.64
"""Minimum likeness of a spot to the marks around, where the lattice predicts a mark and other marks are too
near for the ring. Chosen on pictures of eight sensors, shrunk until their marks were 3 to 8 px apart: 0.6
finds 0.2 % more marks and 0.2 % more false ones."""

MIN_CLUSTER_SIZE: Final = 6
"""Minimum number of marks in a lattice beside a larger one: four or five spots form a parallelogram by chance
(sts_torque160)."""

PROBABILITY_WEIGHTS: Final = (-0.37, -4.72, 5.65, 2.42)
"""Log odds of a mark: constant, and weights of its `evidence`. Fitted to 18 sensors by `python -m
lab.probability dots`, which also reports the calibration of the probability on sensors that were
left out."""

LIKENESS_WINDOW_RADII: Final = 2.6
"""Radius of the discs that are compared, in radii of the marks: they include the gaps to the neighbours.
Chosen on sts_640 and sts_torque160, where glare correlates less with marks than with 1.9 radii."""


class Candidate(NamedTuple):
    """Spots of one scale and polarity that may be the marks of a gel.

    Attributes
    ----------
    spots : of similar strength, apart from each other.
    radius : of a disc with the same response, px.
    score : rank among the candidates of a picture.
    lattice : of their centres.
    """

    spots: Spots
    radius: float
    polarity: Polarity
    score: float
    lattice: Lattice

    @property
    def centers(self) -> Floats:
        """(N, 2) float64, px."""
        return self.spots.points

    @property
    def contrast(self) -> float:
        """Sum of the responses, if all were typical: six lamps must not beat a hundred faint dots."""
        return float(np.median(self.spots.strength)) * len(self.spots.points)

    def __str__(self) -> str:
        return f"{len(self.centers)} {self.polarity} ones of radius {self.radius:.1f} px"


def candidates(scales: Mapping[Polarity, Mapping[float, Spots]]) -> list[Candidate]:
    """The candidates of all polarities and scales, the best first.

    scales : the spots for each polarity and scale, px.
    """
    found = []
    for polarity, by_scale in scales.items():
        for sigma, spots in by_scale.items():
            members = _alike(spots.at(spots.clear > MIN_CLEARANCE))
            if len(members.points):
                lattice = Lattice(members.points)
                candidate = Candidate(members, sigma * RADIUS_PER_SIGMA, polarity, 0.0, lattice)
                score = max(lattice.closed_share - RANDOM_CLOSED_SHARE, 0.0) * candidate.contrast**0.5
                found.append(candidate._replace(score=score))
    return sorted(found, key=lambda one: (one.score, float(one.spots.strength.sum())), reverse=True)


def at_own_scale(chosen: Candidate, found: list[Candidate]) -> Candidate:
    """The candidate of the finer scale that has the marks of a chosen one, further ones, and more contrast.

    A lattice is the more regular the fewer marks it has, so the first candidate may have a scale that is too
    wide for its marks, and lack the small and faint ones at the rim. found : all candidates, the best first.
    """
    for other in found:
        more = len(other.centers) > len(chosen.centers) and other.contrast > chosen.contrast
        if more and other.polarity == chosen.polarity and other.radius < chosen.radius:
            near = cdist(chosen.centers, other.centers) < chosen.radius
            if np.count_nonzero(near.sum(axis=1) != 1) <= MAX_LOST_SPOTS:
                return at_own_scale(other, found)
    return chosen


def marks_of(gray: NDArray[np.float32], chosen: Candidate, by_scale: Mapping[float, Spots]) -> Spots:
    """The marks of all sizes that belong to a candidate.

    gray : (H, W) float32, grey levels. by_scale : the spots of its polarity.
    """
    least = 1 / MAX_STRENGTH_RATIO * float(np.percentile(chosen.spots.strength, 10))
    spots = joined(*(spots.at(spots.strength > least) for spots in by_scale.values()))
    larger = spots.at((spots.radius > 1.01 * chosen.radius) & (spots.clear > MIN_CLEARANCE))
    covers = np.any(cdist(larger.points, chosen.spots.points) < larger.radius[:, None], axis=1)
    either = joined(chosen.spots, larger.at(covers))
    marks = _grown(gray, _in_lattice(_apart(either, either.strength)), spots)
    return marks.at(marks.bend > MIN_BEND_RATIO * np.median(marks.bend)) if len(marks.points) else marks


def evidence(gray: NDArray[np.float32], marks: Spots) -> Floats:
    """Features (N, 3) for the probability that each mark is one; NaN for a single mark.

    The absolute logarithm of the ratio of its response to that of the marks around; its likeness to them, -1
    to 1; and the share of closed ones among its parallelograms, 0 to 1.
    """
    _, around = nearest(marks.points, NEIGHBOUR_COUNT)
    if not around.size:
        return np.full((len(marks.points), 3), np.nan)
    strength = np.log(marks.strength / np.median(marks.strength[around], axis=1))
    alike = likeness(gray, marks.points, marks.points[around], np.median(marks.radius[around], axis=1))
    return np.column_stack([np.abs(strength), alike, Lattice(marks.points).own_shares])


def probability(evidence: Floats) -> Floats:
    """Probability (N,) that each mark is one, from its evidence (N, 3), by logistic regression.

    References
    ----------
    Cox, "The regression analysis of binary sequences", J. Royal Statistical Society B 20 (1958).

    Examples
    --------
    >>> probability(np.array([[0.1, 0.9, 0.8], [1.0, 0.1, 0.0]])) > 0.5
    array([ True, False])
    """
    return np.asarray(
        1 / (1 + np.exp(-PROBABILITY_WEIGHTS[0] - evidence @ PROBABILITY_WEIGHTS[1:])), np.float64
    )


def _alike(spots: Spots) -> Spots:
    """The spots of one scale that may be marks: of similar strength, none between others, none isolated."""
    order = np.argsort(-spots.strength, kind="stable")
    if len(order) == 0:
        return spots
    # Marks are similar in strength, dirt and grain form a tail: cut at a fraction of the typical strength,
    # which is estimated from the top down, independently of the tail's length.
    ranked = spots.strength[order]
    typical = ranked[0]
    for _ in range(8):
        typical = float(np.median(ranked[ranked > MIN_STRENGTH_RATIO * typical]))
    kept = spots.at(order[ranked > MIN_STRENGTH_RATIO * typical])
    for _ in range(3):
        if len(kept.points) < 3:
            return kept
        distances, near = nearest(kept.points, 2)
        pitch = float(np.median(distances[:, 0]))
        between = (distances[:, 0] < MIN_SPACING_PITCHES * pitch) & (
            kept.strength < kept.strength[near[:, 0]]
        )
        lonely = distances[:, 1] > MAX_LINK_PITCHES * pitch
        if not (between | lonely).any():
            break
        kept = kept.at(~(between | lonely))
    return kept


def _in_lattice(marks: Spots) -> Spots:
    """The marks that belong to a lattice, or stand isolated on an even background."""
    if len(marks.points) < NEIGHBOUR_COUNT:
        return marks
    lattice = Lattice(marks.points)
    cluster = lattice.cluster_sizes
    member = (cluster >= min(MIN_CLUSTER_SIZE, cluster.max())) & (lattice.own_shares >= RANDOM_CLOSED_SHARE)
    alike = _ratio(marks.strength, np.median(marks.strength)) < MAX_SIZE_RATIO
    return marks.at(member | (alike & (marks.clear > ISOLATED_CLEARANCE)))


def _grown(gray: NDArray[np.float32], marks: Spots, spots: Spots) -> Spots:
    """Extend the marks by spots where their lattice predicts one, row by row."""
    while len(marks.points) >= NEIGHBOUR_COUNT:
        touching = MIN_SPACING_RADII * (spots.radius[:, None] + marks.radius)
        spots = spots.at(np.all(cdist(spots.points, marks.points) > touching, axis=1))
        new = _wanted(gray, marks, spots)
        if len(new.points) == 0:
            break
        marks = joined(marks, new)
    return marks


def _wanted(gray: NDArray[np.float32], marks: Spots, spots: Spots) -> Spots:
    """The spots, none of which touches a mark, that extend the lattice and resemble the marks around."""
    count = support(spots.points, Lattice(marks.points).predicted)
    wanted, count = spots.at(count > 0), count[count > 0]
    away = cdist(wanted.points, marks.points)
    around = np.argsort(away, axis=1, kind="stable")[:, :NEIGHBOUR_COUNT]
    usual = np.median(marks.radius[around], axis=1)
    radius = _ratio(wanted.radius, usual)
    strength = _ratio(wanted.strength, np.median(marks.strength[around], axis=1))
    fits = (radius < MAX_SIZE_RATIO) & (strength < MAX_STRENGTH_RATIO)
    sure = (wanted.clear > ISOLATED_CLEARANCE) & (strength < MAX_SIZE_RATIO)
    chosen = (wanted.clear > MIN_CLEARANCE) & ((count >= MIN_SUPPORT) | sure)
    left = np.flatnonzero(fits & ~chosen)
    chosen[left] = likeness(gray, wanted.points[left], marks.points[around[left]], usual[left]) > MIN_LIKENESS
    rank = wanted.strength / radius
    return _apart(wanted.at(fits & chosen), rank[fits & chosen])


def _ratio(one: Floats, other: Floats | np.float64) -> Floats:
    """Ratio (n,) of the larger to the smaller of two values."""
    return np.asarray(np.maximum(one / other, other / one), np.float64)


def _apart(spots: Spots, rank: Floats) -> Spots:
    """Keep the spot with the highest rank among spots that touch each other."""
    left = np.ones(len(rank), bool)
    kept = []
    for n in np.argsort(-rank, kind="stable"):
        if left[n]:
            kept.append(n)
            away = np.hypot(*(spots.points - spots.points[n]).T)
            left &= away > MIN_SPACING_RADII * (spots.radius + spots.radius[n])
    return spots.at(np.array(kept, np.int64))


def likeness(gray: NDArray[np.float32], points: Floats, others: Floats, radius: Floats) -> Floats:
    """Likeness of the discs around points to those around others: mean correlation, -1 to 1.

    It is invariant to brightness, contrast and a gradient of the light.

    Parameters
    ----------
    gray : (H, W) float32, grey levels.
    points : (n, 2) float64, px. others : (n, K, 2) float64, px, to compare each with.
    radius : (n,) float64, of the marks there, px.

    Returns
    -------
    likeness : (n,) float64, mean over K; 0 for a uniform disc.

    References
    ----------
    J. P. Lewis, "Fast normalized cross-correlation", Vision Interface (1995).

    Examples
    --------
    >>> gray = np.zeros((20, 40), np.float32)
    >>> gray[8:11, 8:11], gray[8:11, 28:31] = 50, 100
    >>> likeness(gray, np.array([[9.0, 9.0]]), np.array([[[29.0, 9.0]]]), np.array([1.5])).round(3)
    array([1.])
    """
    count, compared = others.shape[:2]
    if not count:
        return np.zeros(0)
    reach = LIKENESS_WINDOW_RADII * radius
    own = _surroundings(gray, points, reach)
    theirs = _surroundings(gray, others.reshape(-1, 2), np.repeat(reach, compared))
    return np.asarray(np.einsum("np,nkp->nk", own, theirs.reshape(count, compared, -1)).mean(axis=1))


def _surroundings(gray: NDArray[np.float32], points: Floats, reach: Floats) -> Floats:
    """Grey levels of the discs around points (n, 2), less mean and gradient, as unit vectors (n, P)."""
    axis = np.linspace(-1, 1, 9)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    inside = x * x + y * y <= 1
    x, y = x[inside], y[inside]
    column = (points[:, :1] + reach[:, None] * x).astype(np.float32)
    row = (points[:, 1:] + reach[:, None] * y).astype(np.float32)
    sampled = cv2.remap(gray, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    levels = sampled.astype(np.float64)
    plane, _ = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))
    levels -= levels @ plane @ plane.T
    return np.asarray(levels / np.maximum(np.linalg.norm(levels, axis=1, keepdims=True), 1e-9))
