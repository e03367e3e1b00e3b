"""Errors against known truth. Pure functions; positions in pixels of the processed frame, angles in degrees.

Where a method gives no answer there is no error to average: such frames are counted separately (missed
contacts, lost markers), so that a method cannot improve its mean by keeping silent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class IdentityErrors:
    """Which markers carry the wrong name.

    wrong : (N,) bool, claimed to be known, but nearer to another marker's true position than to its own, or
        more than half a pitch away from its own.
    lost : (N,) bool, visible, but declared lost by the method.
    """

    wrong: BoolArray
    lost: BoolArray


def _distances(a: FloatArray, b: FloatArray) -> NDArray[np.float64]:
    """(N, M) float64, distance of every row of `a` to every row of `b`, px."""
    # By columns: a sum over pairs of numbers takes eight times as long.
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    dx, dy = np.subtract.outer(a[:, 0], b[:, 0]), np.subtract.outer(a[:, 1], b[:, 1])
    return np.asarray(np.sqrt(dx * dx + dy * dy))


def grid_pitch(points: FloatArray) -> float:
    """Median distance of a point to its nearest neighbour, px.

    Parameters
    ----------
    points : (N, 2) floating, at least two points.

    Raises
    ------
    ValueError
        With fewer than two points: a single point has no pitch.
    """
    if len(points) < 2:
        raise ValueError(f"required at least 2 points for a pitch, got {len(points)}")
    distance = _distances(points, points)
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def match(points: FloatArray, truth: FloatArray, radius: float) -> NDArray[np.int64]:
    """For every true point, the index of the found point that belongs to it, or -1.

    Two points belong together when each is the other's nearest and they are at most `radius` apart. This
    is stricter than an optimal assignment: a detection between two dots belongs to one of them at most.

    Parameters
    ----------
    points : (N, 2) floating, found positions, px.
    truth : (M, 2) floating, true positions, px.
    radius : px, > 0. Half a pitch is the natural choice: beyond it, another dot is as likely.

    Returns
    -------
    (M,) int64, indices into `points`.
    """
    found = np.full(len(truth), -1, dtype=np.int64)
    if len(points) == 0 or len(truth) == 0:
        return found
    distance = _distances(truth, points)
    nearest = np.argmin(distance, axis=1)
    back = np.argmin(distance, axis=0)
    rows = np.arange(len(truth))
    mutual = (back[nearest] == rows) & (distance[rows, nearest] <= radius)
    found[mutual] = nearest[mutual]
    return found


def identity_errors(
    position: FloatArray, truth: FloatArray, visible: BoolArray, lost: BoolArray, pitch: float
) -> IdentityErrors:
    """Judge whether each marker is still the marker it says it is.

    Parameters
    ----------
    position : (N, 2) floating, claimed positions, px.
    truth : (N, 2) floating, true positions of the same markers, px.
    visible : (N,) bool, whether the marker can be seen at all. Others are not judged.
    lost : (N,) bool, whether the method says that it does not know.
    pitch : distance of neighbouring markers at rest, px.
    """
    count = len(truth)
    visible = np.asarray(visible, dtype=np.bool_)
    lost = np.asarray(lost, dtype=np.bool_)
    if count == 0:
        empty = np.zeros(0, dtype=np.bool_)
        return IdentityErrors(empty, empty)
    distance = _distances(position, truth)
    own = np.diagonal(distance).copy()
    nearest = np.argmin(distance, axis=1)
    # Ties go to the marker itself: two dots that truly coincide cannot be told apart by anybody.
    stolen = (nearest != np.arange(count)) & (distance[np.arange(count), nearest] < own)
    wrong = visible & ~lost & (stolen | (own > pitch / 2))
    return IdentityErrors(wrong=wrong, lost=visible & lost)


def displacement_errors(displacement: FloatArray, truth: FloatArray) -> NDArray[np.float64]:
    """(N,) float64, length of the error vector of each displacement, px. Both arguments (N, 2)."""
    error = np.asarray(displacement, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    return np.asarray(np.hypot(error[:, 0], error[:, 1]))


def rms(values: FloatArray | Sequence[float]) -> float | None:
    """Root mean square, or None of nothing."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.sqrt(np.mean(array**2))) if array.size else None


def percentile(values: FloatArray | Sequence[float], q: float) -> float | None:
    """The q-th percentile (0 to 100), or None of nothing."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.percentile(array, q)) if array.size else None


def mean(values: FloatArray | Sequence[float]) -> float | None:
    """Arithmetic mean, or None of nothing."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.mean(array)) if array.size else None


@dataclass(frozen=True, slots=True)
class Detection:
    """Found points against true ones.

    recall, precision : in [0, 1]; 1 where there was nothing to find, or nothing was found.
    errors : (K,) float64, distance of each matched point to the truth, px.
    """

    recall: float
    precision: float
    errors: NDArray[np.float64]


def detection(points: FloatArray, truth: FloatArray, radius: float) -> Detection:
    """Recall, precision and localisation error of found points; see `match` for `radius`."""
    found = match(points, truth, radius)
    hit = found >= 0
    count = int(np.count_nonzero(hit))
    errors = (
        displacement_errors(np.asarray(points)[found[hit]], np.asarray(truth)[hit]) if count else np.zeros(0)
    )
    return Detection(
        recall=count / len(truth) if len(truth) else 1.0,
        precision=count / len(points) if len(points) else 1.0,
        errors=errors,
    )


def polygon_area(polygon: FloatArray) -> float:
    """Area of a simple polygon (N, 2), px^2, by the shoelace formula about its first vertex."""
    if len(polygon) < 3:
        return 0.0
    # About a vertex, not about the image's origin: far from it the products would cancel catastrophically.
    x, y = (np.asarray(polygon, dtype=np.float64) - polygon[0]).T
    return float(abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2)


def lattice_area(hull: FloatArray) -> float:
    """Number of pixels whose centres lie in or on a polygon (N, 2) with corners on pixel centres, px^2.

    This is the area of the convex region that those pixels make up; the polygon through their centres misses
    half a pixel along its border.

    References
    ----------
    G. Pick, "Geometrisches zur Zahlenlehre", Lotos 19 (1899) 311-319.
    """
    if len(hull) == 0:
        return 0.0
    corners = np.rint(np.asarray(hull)).astype(np.int64)
    edge = np.roll(corners, -1, axis=0) - corners
    on_border = int(np.gcd(np.abs(edge[:, 0]), np.abs(edge[:, 1])).sum())
    return polygon_area(corners.astype(np.float64)) + on_border / 2 + 1


def _counter_clockwise(polygon: FloatArray) -> NDArray[np.float64]:
    points = np.asarray(polygon, dtype=np.float64)
    x, y = (points - points[0]).T
    signed = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    return points if signed >= 0 else points[::-1]


def clip_convex(subject: FloatArray, clip: FloatArray) -> NDArray[np.float64]:
    """Intersection of two convex polygons.

    Parameters
    ----------
    subject, clip : (N, 2), (M, 2) floating, vertices in order, either sense, px.

    Returns
    -------
    (K, 2) float64, vertices of the intersection; K = 0 where they do not overlap.

    References
    ----------
    I. Sutherland and G. Hodgman, "Reentrant polygon clipping", Comm. ACM 17 (1974) 32-42.
    """
    if len(subject) < 3 or len(clip) < 3:
        return np.zeros((0, 2))
    result = _counter_clockwise(subject)
    border = _counter_clockwise(clip)
    for start, end in zip(border, np.roll(border, -1, axis=0), strict=True):
        if len(result) == 0:
            break
        edge = end - start
        side = edge[0] * (result[:, 1] - start[1]) - edge[1] * (result[:, 0] - start[0])
        after = np.roll(result, -1, axis=0)
        side_after = np.roll(side, -1)
        kept: list[NDArray[np.float64]] = []
        for point, following, s, t in zip(result, after, side, side_after, strict=True):
            if s >= 0:
                kept.append(point)
            if (s > 0 > t) or (s < 0 < t):
                kept.append(point + (following - point) * (s / (s - t)))
        result = np.asarray(kept).reshape(-1, 2)
    return result


def convex_iou(a: FloatArray, b: FloatArray) -> float:
    """Intersection over union of two convex polygons, in [0, 1]. Exact: no pixels are counted.

    Two polygons without area are equal (1) only if both are empty; otherwise they share nothing (0).
    """
    area_a, area_b = polygon_area(a), polygon_area(b)
    common = polygon_area(clip_convex(a, b))
    union = area_a + area_b - common
    if union <= 0:
        return 1.0 if len(a) == len(b) == 0 else 0.0
    return float(min(1.0, common / union))


def mask_iou(a: NDArray[np.generic], b: NDArray[np.generic]) -> float:
    """Intersection over union of two masks (non-zero is inside), in [0, 1]; 1 where both are empty."""
    if a.shape != b.shape:
        raise ValueError(f"required masks of one shape, got {a.shape} and {b.shape}")
    inside_a, inside_b = np.asarray(a) != 0, np.asarray(b) != 0
    union = int(np.count_nonzero(inside_a | inside_b))
    return int(np.count_nonzero(inside_a & inside_b)) / union if union else 1.0


def angle_error(angle: float, truth: float) -> float:
    """Difference of two undirected axes, degrees in [0, 90]. 89 and -89 differ by 2, not by 178."""
    difference = abs(angle - truth) % 180.0
    return min(difference, 180.0 - difference)


def masked_mae(image: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.generic]) -> float | None:
    """Mean absolute error inside the mask, grey levels; None where the mask is empty."""
    inside = np.asarray(mask) != 0
    if not inside.any():
        return None
    return float(np.mean(cv2.absdiff(image, truth)[inside]))


def masked_psnr(
    image: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.generic]
) -> float | None:
    """Peak signal-to-noise ratio inside the mask, dB (peak 255, at most 100); None for an empty mask."""
    inside = np.asarray(mask) != 0
    if not inside.any():
        return None
    squared = float(np.mean(np.square(cv2.absdiff(image, truth)[inside], dtype=np.float64)))
    # Equal images have no finite ratio; 100 dB is a mean squared error far below one quantisation step.
    return 100.0 if squared <= 255.0**2 * 1e-10 else float(10 * np.log10(255.0**2 / squared))


def mask_centroids(mask: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 2) float64, centroids of the connected regions of a marker mask, px."""
    _, _, _, centroids = cv2.connectedComponentsWithStats(mask, connectivity=8)
    return np.asarray(centroids[1:], dtype=np.float64)


def shared_dots(position: FloatArray, trusted: BoolArray, pitch: float) -> int:
    """How many trusted markers stand on a dot that another trusted marker also claims.

    Two markers closer than a quarter of the grid's pitch share a dot: real dots are larger than that, so
    they cannot come so near without being one blob.

    Parameters
    ----------
    position : (N, 2) floating, px. trusted : (N,) bool, not declared lost. pitch : px.
    """
    known = np.asarray(position)[np.asarray(trusted)]
    if len(known) < 2:
        return 0
    distance = _distances(known, known)
    np.fill_diagonal(distance, np.inf)
    return int(np.count_nonzero(distance.min(axis=1) < pitch / 4))


def neighbours(origin: FloatArray, reach: float = 1.25) -> NDArray[np.int64]:
    """(E, 2) int64, pairs of markers that are neighbours in the grid.

    Parameters
    ----------
    origin : (N, 2) floating, positions in the reference frame, px.
    reach : in pitches. 1.25 takes the four neighbours of a square grid, 1.5 also its diagonals.
    """
    if len(origin) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    distance = _distances(origin, origin)
    pairs = np.argwhere(np.triu(distance <= reach * grid_pitch(origin), k=1))
    return np.asarray(pairs, dtype=np.int64)


def flow_jumps(displacement: FloatArray, trusted: BoolArray, pairs: NDArray[np.int64], pitch: float) -> int:
    """How many trusted markers move unlike their neighbours: more than half a pitch from the median.

    A gel is continuous, so neighbouring dots move alike; a jump of more than half a pitch means that one of
    the two carries a wrong name.

    Parameters
    ----------
    displacement : (N, 2) floating, px. trusted : (N,) bool. pairs : from `neighbours`. pitch : px.
    """
    displacement = np.asarray(displacement, dtype=np.float64)
    trusted = np.asarray(trusted, dtype=np.bool_)
    count = len(displacement)
    near: list[list[int]] = [[] for _ in range(count)]
    for i, j in pairs:
        near[i].append(int(j))
        near[j].append(int(i))
    jumps = 0
    for index in np.flatnonzero(trusted):
        around = [j for j in near[index] if trusted[j]]
        if len(around) < 2:
            continue
        typical = np.median(displacement[around], axis=0)
        jumps += int(np.hypot(*(displacement[index] - typical)) > pitch / 2)
    return jumps
