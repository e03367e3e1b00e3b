"""The lens of a camera: from distorted to undistorted pixels and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tactflow.vision.arrays import Floats

_DISTORTION_LENGTHS: Final = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV's polynomial model knows."""
_CONVERGED: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
"""Where the iterations of `Lens.undistort` end: after so many steps, or at so small an error."""

# OpenCV 4 has a name of its own for the function that takes a stopping rule.
_undistort: Final[Any] = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


@dataclass(frozen=True, eq=False, slots=True)
class Lens:
    """A camera's intrinsic calibration, as `cv2.calibrateCamera` or `cv2.fisheye.calibrate` give it.

    camera_matrix : (3, 3) float64, px.
    distortion : (4 | 5 | 8 | 12 | 14,) float64 for the polynomial model, (4,) for the fisheye model.
    fisheye : which of the two models.

    >>> lens = Lens(np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), np.array([-0.2, 0, 0, 0]))
    >>> lens.distort(np.array([[100.0, 100.0]])).round(2)
    array([[111.97, 107.62]])
    >>> lens.undistort(lens.distort(np.array([[100.0, 100.0]]))).round(6)
    array([[100., 100.]])
    """

    camera_matrix: Floats
    distortion: Floats
    fisheye: bool = False

    def distort(self, points: Floats) -> Floats:
        """Where the lens puts points of the undistorted frame: (N, 2) float64 px -> (N, 2) float64 px."""
        if len(points) == 0:
            return points.copy()
        matrix = self.camera_matrix
        normalised = np.empty((len(points), 2))
        normalised[:, 1] = (points[:, 1] - matrix[1, 2]) / matrix[1, 1]
        normalised[:, 0] = (points[:, 0] - matrix[0, 2] - matrix[0, 1] * normalised[:, 1]) / matrix[0, 0]
        # OpenCV ignores a camera matrix's skew: it gets the identity, and the matrix is applied here.
        if self.fisheye:
            projected = cv2.fisheye.distortPoints(normalised[:, None], np.eye(3), self.distortion)
        else:
            rays, nothing = np.column_stack([normalised, np.ones(len(points))]), np.zeros(3)
            projected, _ = cv2.projectPoints(rays[:, None], nothing, nothing, np.eye(3), self.distortion)
        bent = np.asarray(projected, dtype=np.float64).reshape(-1, 2)
        return bent @ matrix[:2, :2].T + matrix[:2, 2]

    def undistort(self, points: Floats) -> Floats:
        """Inverse of `distort`: (N, 2) float64 px -> (N, 2) float64 px.

        A point that no undistorted point maps to ends wherever OpenCV's iteration came to.
        """
        if len(points) == 0:
            return points.copy()
        # OpenCV ignores a camera matrix's skew: it gets the identity, and the matrix is applied here.
        inverse = np.linalg.inv(self.camera_matrix)
        bent = (points @ inverse[:2, :2].T + inverse[:2, 2]).reshape(-1, 1, 2)
        if self.fisheye:
            rays = cv2.fisheye.undistortPoints(bent, np.eye(3), self.distortion, criteria=_CONVERGED)
        else:
            rays = _undistort(bent, np.eye(3), self.distortion, criteria=_CONVERGED)
        straight = np.asarray(rays, np.float64).reshape(-1, 2)
        return straight @ self.camera_matrix[:2, :2].T + self.camera_matrix[:2, 2]


def check_lens(camera_matrix: ArrayLike | None, distortion: ArrayLike | None, fisheye: bool) -> Lens | None:
    """The lens of a calibration, or None where neither matrix nor coefficients are given.

    camera_matrix : (3, 3), px. distortion : 4, 5, 8, 12 or 14 coefficients; fisheye: 4.
    Raises ValueError where only one of them is given, or where they do not have these forms.

    >>> check_lens([[500, 0, 320], [0, 500, 240], [0, 0, 1]], [-0.2, 0.1, 0, 0], fisheye=False).distortion
    array([-0.2,  0.1,  0. ,  0. ])
    >>> check_lens(None, None, fisheye=False) is None
    True
    """
    if camera_matrix is None and distortion is None:
        if fisheye:
            raise ValueError("required camera_matrix and distortion with fisheye, got neither")
        return None
    if camera_matrix is None or distortion is None:
        missing = "camera_matrix" if camera_matrix is None else "distortion"
        raise ValueError(f"required both camera_matrix and distortion, got no {missing}")
    matrix = np.array(camera_matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ValueError(f"required a finite 3 x 3 camera_matrix, got shape {matrix.shape}")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise ValueError(f"required focal lengths > 0 px, got {matrix[0, 0]:g}, {matrix[1, 1]:g}")
    if matrix[1, 0] or not np.array_equal(matrix[2], [0.0, 0.0, 1.0]):
        raise ValueError("required camera_matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], got another form")
    coefficients = np.array(distortion, dtype=np.float64).ravel()
    lengths = (4,) if fisheye else _DISTORTION_LENGTHS
    if len(coefficients) not in lengths:
        wanted = " or ".join(map(str, lengths))
        model = "fisheye" if fisheye else "polynomial"
        raise ValueError(f"required {wanted} {model} distortion coefficients, got {len(coefficients)}")
    if not np.isfinite(coefficients).all():
        raise ValueError(f"required finite distortion coefficients, got {coefficients.tolist()}")
    return Lens(matrix, coefficients, fisheye)
