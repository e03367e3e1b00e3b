"""Errors against known truth, of outlines, centres, directions, dots, identities and pictures.

Pure functions; positions in pixels of the processed frame, x right, y down; angles in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from tactflow.vision.arrays import Flags

FloatArray = NDArray[np.floating[Any]]


def pixel_area(hull: FloatArray) -> float:
    """Number of pixels whose centres lie in or on a polygon (N, 2), N > 0, with corners on pixel centres.

    By Pick, "Geometrisches zur Zahlenlehre", Lotos 19 (1899) 311-319.
    """
    corners = np.rint(hull).astype(np.int32)
    on_border = np.gcd(*(np.roll(corners, -1, axis=0) - corners).T).sum()
    return float(cv2.contourArea(corners) + on_border / 2 + 1)


def mask_iou(a: NDArray[np.generic], b: NDArray[np.generic]) -> float:
    """Intersection over union of two masks (H, W), non-zero inside, in [0, 1]; 1 where both are empty."""
    inside_a, inside_b = np.asarray(a) != 0, np.asarray(b) != 0
    union = int(np.count_nonzero(inside_a | inside_b))
    return int(np.count_nonzero(inside_a & inside_b)) / union if union else 1.0


def filled_polygons(polygons: Sequence[NDArray[Any]], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W) uint8: 255 inside any of the polygons (N, 2), px. shape : (H, W)."""
    mask = np.zeros(shape, np.uint8)
    for polygon in filter(len, polygons):
        cv2.fillPoly(mask, [np.rint(polygon).astype(np.int32)], (255,))
    return mask


def polygon_iou(a: NDArray[Any], b: NDArray[Any], shape: tuple[int, int]) -> float:
    """`mask_iou` of two polygons (N, 2), px, of a picture of `shape` (H, W)."""
    return mask_iou(filled_polygons([a], shape), filled_polygons([b], shape))


def distance(a: ArrayLike, b: ArrayLike) -> Any:
    """Distance of points (..., 2) to others, px: a float for two points, else an array (...)."""
    error = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    return np.hypot(error[..., 0], error[..., 1])


def angle_error(angle: float, truth: float) -> float:
    """Difference of two undirected axes, degrees in [0, 90]: 89 and -89 differ by 2, not by 178."""
    difference = abs(angle - truth) % 180.0
    return min(difference, 180.0 - difference)


def aspect_ratio(mask: NDArray[np.generic]) -> float:
    """Ratio of the principal axes of a region (H, W), >= 1; 1 where there is none.

    A pixel has an extent of its own: 1/12 px^2 along each axis belongs to the variance.
    """
    moments = cv2.moments(np.asarray(mask, dtype=np.uint8), binaryImage=True)
    count = moments["m00"]
    if count == 0:
        return 1.0
    xx, yy, xy = (moments[name] / count for name in ("mu20", "mu02", "mu11"))
    middle, half = (xx + yy) / 2 + 1 / 12, float(np.hypot(xx - yy, 2 * xy)) / 2
    return float(np.sqrt((middle + half) / (middle - half)))


def dot_pitch(points: FloatArray) -> float:
    """Median distance of a point (N, 2) to its nearest neighbour, px; infinite for a single point."""
    apart = cdist(points, points)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1, initial=np.inf)))


def mask_centroids(mask: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(N, 2) float64, centroids of the connected regions of a marker mask (H, W), px."""
    _, _, _, centroids = cv2.connectedComponentsWithStats(mask, connectivity=8)
    return np.asarray(centroids[1:], dtype=np.float64)


def match_points(points: FloatArray, truth: FloatArray, radius: float) -> NDArray[np.int64]:
    """For every true point, the index of the found point that belongs to it, or -1.

    Two points belong together when each is the other's nearest and they are at most `radius` apart. This
    is stricter than an optimal assignment: a detection between two dots belongs to one of them at most.

    points : (N, 2), found positions, px. truth : (M, 2), true ones. radius : px; half a pitch is the natural
    choice: beyond it, another dot is as likely. Returns (M,) int64, indices into `points`.
    """
    index = np.full(len(truth), -1, dtype=np.int64)
    if len(points) == 0 or len(truth) == 0:
        return index
    apart = cdist(truth, points)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    rows = np.arange(len(truth))
    mutual = (back[nearest] == rows) & (apart[rows, nearest] <= radius)
    index[mutual] = nearest[mutual]
    return index


def detection(points: FloatArray, truth: FloatArray, radius: float) -> tuple[float, float, FloatArray]:
    """Recall and precision of found points, and (K,) px, the distance of each matched one to the truth.

    Arguments as for `match_points`. Both shares are 1 where there was nothing to find, or nothing was found.
    """
    index = match_points(points, truth, radius)
    hit = index >= 0
    count = int(np.count_nonzero(hit))
    errors = distance(points[index[hit]], truth[hit]) if count else np.zeros(0)
    return count / len(truth) if len(truth) else 1.0, count / len(points) if len(points) else 1.0, errors


def identity_errors(position: FloatArray, truth: FloatArray, pitch: float) -> Flags:
    """Which markers have the wrong identity: nearer to another's true position, or off by half a pitch.

    position, truth : (N, 2), claimed and true positions of the same markers, px. pitch : distance of
    neighbouring markers at rest, px. Returns (N,) bool.
    """
    apart = cdist(position, truth)
    own = np.diagonal(apart)
    # Ties count as correct: coinciding dots cannot be distinguished.
    nearest = apart.min(axis=1, initial=np.inf)
    return np.asarray((nearest < own) | (own > pitch / 2))
