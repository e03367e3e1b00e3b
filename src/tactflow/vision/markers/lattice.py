"""The lattice of the marks: which are neighbours, and whether they form parallelograms."""

from __future__ import annotations

from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import median
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from tactflow.vision.arrays import Floats, Indices

BLOCKING_RATIO: Final = 1.1
"""Sum of the squared distances of a third mark to two others, over the squared distance of these, below which
it blocks their link. At a right angle it is 1; a tenth more keeps a skewed square free of diagonals. Chosen
by hand."""

MAX_LINK_PITCHES: Final = 2.3
"""Maximum distance of neighbours, pitches: that of the two marks on either side of a missing one. Without
this bound on the second nearest, two more of twelve simulated cloths show marks (measured)."""

MAX_LINK_RATIO: Final = 2.0
"""Maximum length of a link, relative to the median one at either end: it may span one missing mark. Without
this bound, the bright rims of a TacTip's pins are taken for marks."""

CLOSING_DISTANCE_SIDES: Final = 0.25
"""Maximum distance of a mark from the fourth corner of a parallelogram, in mean sides. Chosen by hand."""

MAX_CORNER_COSINE: Final = 0.8
"""Cosine of the angle between two sides above which they span no parallelogram. With 0.71, marks of a grid in
perspective are lost (sts_torque160)."""

NEIGHBOUR_COUNT: Final = 4
"""Number of neighbours that a mark is compared with: those of a square grid."""

PRIOR_OPEN_COUNT: Final = 4.0
"""Pseudo-count of open parallelograms, so that a lattice of few marks needs more evidence. Without it, three
more of 121 pictures without dots show a lattice."""


class Corners(NamedTuple):
    """Fourth corners of the parallelograms spanned by two neighbours of a mark.

    Attributes
    ----------
    points : (M, 2) float64, px.
    reach : (M,) float64, maximum distance of a mark that closes it, px.
    first, middle, last : (M,) int64, the marks that span it.
    """

    points: Floats
    reach: Floats
    first: Indices
    middle: Indices
    last: Indices


class Lattice:
    """The lattice of a set of marks: their links, and the parallelograms of these. Computed lazily.

    Parameters
    ----------
    points : (N, 2) float64, px.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(0, 100, 10.0), np.arange(0, 100, 10.0))
    >>> lattice = Lattice(np.column_stack([x.ravel(), y.ravel()]))
    >>> len(lattice.links), round(lattice.closed_share, 2)
    (180, 0.99)
    """

    def __init__(self, points: Floats) -> None:
        self.points = points

    @cached_property
    def links(self) -> Indices:
        """(E, 2) int64, neighbours without links that are much longer than the others at either end."""
        if len(self.points) < 2:
            return np.zeros((0, 2), np.int64)
        edges = neighbour_graph(self.points, MAX_LINK_PITCHES * pitch_of(self.points))
        if not len(edges):
            return edges
        length = np.hypot(*(self.points[edges[:, 0]] - self.points[edges[:, 1]]).T)
        usual = np.asarray(median(np.tile(length, 2), edges.T.ravel(), np.arange(len(self.points))))
        return np.asarray(edges[length < MAX_LINK_RATIO * usual[edges].min(axis=1)], np.int64)

    @cached_property
    def corners(self) -> Corners:
        """Fourth corners of the parallelograms of linked marks."""
        return corners(self.points, self.links)

    @property
    def closed_share(self) -> float:
        """Regularity: the share of parallelograms that a mark closes.

        Real grids, including hand-painted, curved and tilted ones, have 0.8 and more; marks scattered at
        random have 0.1, or 0.3 if they keep a distance from each other (measured).
        """
        return float(np.count_nonzero(self._closing >= 0) / (len(self.corners.points) + PRIOR_OPEN_COUNT))

    @property
    def own_shares(self) -> Floats:
        """(N,) float64, for each mark, the share of closed ones among its parallelograms; 0 without any."""
        count, closing = len(self.points), self._closing
        tests, own = np.zeros(count), np.zeros(count)
        for part in self.corners[2:]:
            tests += np.bincount(part, minlength=count)
        for part in self._cells.T:
            own += np.bincount(part, minlength=count)
        tests += np.bincount(closing[closing >= 0], minlength=count)
        return np.asarray(own / np.maximum(tests, 1), np.float64)

    @property
    def cluster_sizes(self) -> Indices:
        """(N,) int64, how many marks closed parallelograms connect to each mark, itself included."""
        count = len(self.points)
        cluster = components(self._cells, count)
        return np.bincount(cluster, minlength=count)[cluster]

    @property
    def predicted(self) -> Corners:
        """Where marks are predicted: at corners of parallelograms, and one step further along each line.

        A step is as long as the one before it; or, as towards a horizon, shorter by the same factor as that
        one. Of these two predictions, `support` counts one.
        """
        found, (first, last) = self.corners, np.concatenate([self.links, self.links[:, ::-1]]).T
        scales = np.stack([np.ones(len(first)), self._foreshortening(first, last)])
        steps = (self.points[last] - self.points[first]) * scales[:, :, None]
        return Corners(
            np.concatenate([found.points, *(self.points[last] + steps)]),
            np.concatenate([found.reach, *(CLOSING_DISTANCE_SIDES * np.linalg.norm(steps, axis=2))]),
            np.concatenate([found.first, first, first]),
            np.concatenate([found.middle, last, last]),
            np.concatenate([found.last, last, last]),
        )

    def _foreshortening(self, first: Indices, last: Indices) -> Floats:
        """(L,) length of each link from `first` to `last`, (L,), over that of the link before it in line; 1
        without one, or where it is longer, which tells of a missing mark."""
        middle, one, other = pairs_of_links(self.links)
        before, after = self.points[one] - self.points[middle], self.points[other] - self.points[middle]
        lengths = np.hypot(*before.T), np.hypot(*after.T)
        straight = (before * after).sum(axis=1) < -MAX_CORNER_COSINE * lengths[0] * lengths[1]
        middle, ratio = middle[straight], (lengths[1] / lengths[0])[straight]
        count, result = len(self.points), np.ones(len(first))
        number = first * count + last
        order = np.argsort(number)
        for end, scale in ((other[straight], ratio), (one[straight], 1 / ratio)):
            link = order[np.searchsorted(number, middle * count + end, sorter=order)]
            result[link] = np.minimum(scale, 1)
        return result

    @cached_property
    def _closing(self) -> Indices:
        """Index (M,) of the mark that closes each parallelogram, or -1."""
        expected = self.corners
        if len(expected.points) == 0:
            return np.zeros(0, np.int64)
        away, near = map(np.asarray, KDTree(self.points).query(expected.points, 2))
        # The middle mark is opposite to the corner and cannot close it.
        second = (near[:, 0] == expected.middle).astype(np.int64)
        which = np.arange(len(near))
        return np.where(away[which, second] < expected.reach, near[which, second], -1)

    @property
    def _cells(self) -> Indices:
        """(C, 4) int64, the marks of each closed parallelogram."""
        return np.column_stack([*self.corners[2:], self._closing])[self._closing >= 0]


def neighbour_graph(centers: Floats, longest: float) -> Indices:
    """The graph of neighbouring marks: a beta-skeleton, free of diagonals on square grids.

    Two marks are neighbours unless a third one lies (nearly) inside the circle that has them as its diameter.

    Parameters
    ----------
    centers : (N, 2) float64, px. longest : maximum distance of neighbours, px.

    Returns
    -------
    edges : (E, 2) int64, each pair once, smaller index first, sorted. Coinciding marks are not linked.

    References
    ----------
    Gabriel and Sokal, "A new statistical approach to geographic variation analysis", Systematic Zoology 18
    (1969); Kirkpatrick and Radke, "A framework for computational morphology" (1985).

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
    >>> neighbour_graph(square, 20.0).tolist()
    [[0, 1], [0, 2], [1, 3], [2, 3]]
    """
    if len(centers) < 2:
        return np.zeros((0, 2), np.int64)
    tree = KDTree(centers)
    pairs = tree.query_pairs(longest, output_type="ndarray")
    one, other = centers[pairs[:, 0]], centers[pairs[:, 1]]
    length = np.hypot(*(one - other).T)
    # By Apollonius' theorem, a third mark blocks the link if it is this near to the midpoint, as the two
    # marks themselves are.
    reach = length * np.sqrt((BLOCKING_RATIO - 0.5) / 2)
    near = np.asarray(tree.query_ball_point((one + other) / 2, reach, return_length=True))
    edges = pairs[(near == 2) & (length > 0)]
    return np.asarray(edges[np.lexsort((edges[:, 1], edges[:, 0]))], np.int64)


def nearest(points: Floats, count: int) -> tuple[Floats, Indices]:
    """Distances to and indices of the `count` nearest other points, nearest first: two (N, count) arrays."""
    count = min(count, len(points) - 1)
    if count < 1:
        return np.zeros((len(points), 0)), np.zeros((len(points), 0), np.int64)
    # The nearest one is the point itself.
    distances, near = KDTree(points).query(points, np.arange(2, count + 2))
    return np.asarray(distances, np.float64), np.asarray(near, np.int64)


def pitch_of(points: Floats) -> float:
    """Median distance of marks (N, 2), N >= 2, to their nearest neighbours, px."""
    return float(np.median(nearest(points, 1)[0]))


def corners(centers: Floats, edges: Indices) -> Corners:
    """Predict the fourth corners of the parallelograms of neighbours (E, 2).

    >>> square = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    >>> corners(square, np.array([[0, 1], [0, 2]])).points.tolist()
    [[10.0, 10.0]]
    """
    c, a, b = pairs_of_links(edges)
    one, other = centers[a] - centers[c], centers[b] - centers[c]
    lengths = np.hypot(*one.T), np.hypot(*other.T)
    open_ = np.abs((one * other).sum(axis=1)) < MAX_CORNER_COSINE * lengths[0] * lengths[1]
    reach = CLOSING_DISTANCE_SIDES * (lengths[0] + lengths[1])[open_] / 2
    return Corners((centers[c] + one + other)[open_], reach, a[open_], c[open_], b[open_])


def pairs_of_links(edges: Indices) -> tuple[Indices, Indices, Indices]:
    """All pairs of links (E, 2) that meet: the mark where they do, and their two other ends, (P,) each.

    >>> [part.tolist() for part in pairs_of_links(np.array([[0, 1], [1, 2]]))]
    [[1], [0], [2]]
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    middle, first, last = ([np.zeros(0, np.int64)] for _ in range(3))
    # Pair each link with the one 1, 2, ... places after it, as long as both start at the same mark.
    for step in range(1, np.bincount(both[:, 0]).max(initial=1)):
        same = np.flatnonzero(both[:-step, 0] == both[step:, 0])
        middle.append(both[same, 0])
        first.append(both[same, 1])
        last.append(both[same + step, 1])
    c, a, b = (np.concatenate(part) for part in (middle, first, last))
    return c, a, b


def components(groups: Indices, count: int) -> Indices:
    """Label (count,) of the connected component of each mark; groups : (C, k), connected marks."""
    first, others = np.repeat(groups[:, 0], groups.shape[1] - 1), groups[:, 1:].ravel()
    linked = coo_array((np.ones(len(first)), (first, others)), shape=(count, count))
    return np.asarray(connected_components(linked, directed=False)[1], np.int64)


def support(points: Floats, expected: Corners) -> Indices:
    """Number (n,) of corners that each point (n, 2) closes; those that the same marks span count once."""
    if not (len(points) and len(expected.points)):
        return np.zeros(len(points), np.int64)
    closing = KDTree(points).query_ball_point(expected.points, expected.reach)
    corner = np.repeat(np.arange(len(closing)), [len(near) for near in closing])
    pairs = np.column_stack(
        [np.concatenate(closing).astype(np.int64), *(part[corner] for part in expected[2:])]
    )
    return np.bincount(np.unique(pairs, axis=0)[:, 0], minlength=len(points))
