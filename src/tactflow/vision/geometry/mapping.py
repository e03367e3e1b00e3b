"""The exact relation between the pixels of the raw and of the processed frame.

All coordinates have the centre of the top-left pixel at (0, 0). A k-fold block average therefore maps x to
(x - (k - 1) / 2) / k, while `cv2.pyrDown`, whose output pixel i is centred on input pixel 2 i, maps x to
x / 2: the two pictures look alike and lie half a raw pixel apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tactflow.vision.arrays import Floats
from tactflow.vision.geometry.lens import Lens

_MAX_COLLINEAR_AREA_SHARE: Final = 1e-6
"""Twice the area of a triangle, over the squared extent of the four points, up to which its corners are
collinear. Chosen by hand."""
_MIN_HOMOGENEOUS_DEPTH: Final = 1e-12
"""Smallest homogeneous depth that is divided by, 1. A point on the horizon has no finite image; a huge but
finite one keeps every later number finite. Chosen by hand."""


@dataclass(frozen=True, eq=False, slots=True)
class PixelMapping:
    """The exact relation between raw and processed pixel coordinates.

    Attributes
    ----------
    raw_size, size : (width, height) of the raw and of the processed frame, px.
    matrix : (3, 3) float64, homogeneous, from undistorted raw to processed pixels.
    lens : whose distortion was removed before, or None.

    Examples
    --------
    >>> from tactflow.vision.geometry import Preprocessor
    >>> mapping = Preprocessor((800, 600), downsample=2).mapping
    >>> mapping.to_processed([[0.5, 0.5], [2.5, 0.5]])
    array([[0., 0.],
           [1., 0.]])
    >>> mapping.to_raw([1.0, 0.0])
    array([2.5, 0.5])
    """

    raw_size: tuple[int, int]
    size: tuple[int, int]
    matrix: Floats
    lens: Lens | None = None

    @classmethod
    def identity(cls, size: tuple[int, int]) -> PixelMapping:
        """The mapping of a frame of size (width, height) that is left as it is."""
        return cls(size, size, np.eye(3))

    def to_processed(self, points: ArrayLike) -> Floats:
        """Where points of the raw frame lie in the processed frame.

        points : (N, 2) or (2,), raw pixels, x right, y down. Returns the same shape, float64, processed
        pixels, also for points outside the frame. Raises ValueError on another shape, or for coordinates that
        are not finite.
        """
        places = _points(points)
        raw = places.reshape(-1, 2)
        straight = raw if self.lens is None else self.lens.undistort(raw)
        return project(self.matrix, straight).reshape(places.shape)

    def to_raw(self, points: ArrayLike) -> Floats:
        """Where points of the processed frame lie in the raw frame: inverse of `to_processed`."""
        places = _points(points)
        straight = project(np.asarray(np.linalg.inv(self.matrix), np.float64), places.reshape(-1, 2))
        return (straight if self.lens is None else self.lens.distort(straight)).reshape(places.shape)


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
    matrix = np.append(np.linalg.solve(np.array(rows), end.ravel()), 1.0).reshape(3, 3)
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
    depth = homogeneous[:, 2:]
    return np.asarray(
        homogeneous[:, :2] / np.where(np.abs(depth) < _MIN_HOMOGENEOUS_DEPTH, _MIN_HOMOGENEOUS_DEPTH, depth)
    )


def _corners(name: str, points: ArrayLike) -> Floats:
    """Four points (4, 2) of which no three lie on a line; ValueError otherwise."""
    corners = np.array(points, np.float64)
    if corners.shape != (4, 2) or not np.isfinite(corners).all():
        raise ValueError(f"required four finite {name} points (x, y), got {corners.tolist()}")
    extent = float(np.ptp(corners, axis=0).max())
    for a, b, c in combinations(corners, 3):
        if abs(np.linalg.det([b - a, c - a])) <= _MAX_COLLINEAR_AREA_SHARE * extent**2:
            raise ValueError(
                f"required {name} points of which no three lie on a line, got {corners.tolist()}"
            )
    return corners


def _points(points: ArrayLike) -> Floats:
    places = np.asarray(points, np.float64)
    if places.ndim not in (1, 2) or places.shape[-1:] != (2,):
        raise ValueError(f"required points of shape (N, 2), got {places.shape}")
    if not np.isfinite(places).all():
        raise ValueError("required finite points, got NaN or infinity among them")
    return places
