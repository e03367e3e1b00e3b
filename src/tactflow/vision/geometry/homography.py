"""Homographies: projective mappings of the plane as (3, 3) matrices."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tactflow.vision.arrays import Floats

_COLLINEAR: Final = 1e-6
"""Twice a triangle's area over the squared extent of the four points, 1: up to here its corners lie on a
line. Chosen by hand."""
_AT_HORIZON: Final = 1e-12
"""Smallest homogeneous depth that is divided by, 1. A point on the horizon has no finite image; a huge but
finite one keeps every later number finite. Chosen by hand."""


def find_homography(source: ArrayLike, destination: ArrayLike) -> Floats:
    """The homography that takes four points to four points.

    source, destination : (4, 2), px, in the same order. Returns (3, 3) float64. Raises ValueError where three
    points lie on a line, or where one outline is crossed and the other is not.

    >>> square = [[0, 0], [10, 0], [10, 10], [0, 10]]
    >>> matrix = find_homography(square, [[5, 5], [25, 5], [25, 25], [5, 25]])
    >>> project(matrix, np.array([[5.0, 5.0]])).round(6)
    array([[15., 15.]])
    """
    start, end = _corners("source", source), _corners("destination", destination)
    rows = []
    for (x, y), (u, v) in zip(start, end, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y])
    try:
        solution = np.linalg.solve(np.array(rows), end.ravel())
    except np.linalg.LinAlgError:
        raise ValueError("required points that define a homography, got degenerate ones") from None
    matrix = np.append(solution, 1.0).reshape(3, 3)
    depths = start @ matrix[2, :2] + 1.0
    if depths.min() * depths.max() <= 0:
        raise ValueError(
            "required source and destination points in the same order around their outline, "
            f"got {start.tolist()} to {end.tolist()}"
        )
    return matrix


def project(matrix: Floats, points: Floats) -> Floats:
    """Where a homography takes points: (3, 3), (N, 2) px -> (N, 2) float64 px.

    >>> project(np.diag([2.0, 2.0, 1.0]), np.array([[3.0, 4.0]]))
    array([[6., 8.]])
    """
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    depth = homogeneous[:, 2]
    depth = np.where(np.abs(depth) < _AT_HORIZON, _AT_HORIZON, depth)
    return homogeneous[:, :2] / depth[:, None]


def _corners(name: str, points: ArrayLike) -> Floats:
    """Four points (4, 2) of which no three lie on a line; ValueError otherwise."""
    corners = np.array(points, dtype=np.float64)
    if corners.shape != (4, 2) or not np.isfinite(corners).all():
        raise ValueError(f"required four finite {name} points (x, y), got shape {corners.shape}")
    extent = float(np.ptp(corners, axis=0).max())
    for left_out in range(4):
        a, b, c = np.delete(corners, left_out, axis=0)
        twice_area = abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
        if twice_area <= _COLLINEAR * extent * extent:
            raise ValueError(
                f"required {name} points of which no three lie on a line, got {corners.tolist()}"
            )
    return corners
