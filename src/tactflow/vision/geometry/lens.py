"""The lens of a camera: from distorted to undistorted pixels and back."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tactflow.vision.arrays import Floats

_COEFFICIENT_COUNTS: Final = {False: (4, 5, 8, 12, 14), True: (4,)}
"""Numbers of coefficients of OpenCV's polynomial and fisheye models."""
_STOPPING_CRITERIA: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
"""Stopping rule of the iterations of `Lens.undistort`: number of steps, or error."""

# OpenCV 4 has a name of its own for the function that takes a stopping rule.
_undistort: Final[Any] = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


class Lens:
    """A camera's intrinsic calibration, as `cv2.calibrateCamera` or `cv2.fisheye.calibrate` gives it.

    Raises ValueError for a matrix of another form, or other numbers of coefficients.

    Parameters
    ----------
    camera_matrix : (3, 3), px, without skew: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    distortion : 4, 5, 8, 12 or 14 coefficients of the polynomial model, or 4 of the fisheye model.
    fisheye : which of the two models.

    Examples
    --------
    >>> lens = Lens([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], [-0.2, 0, 0, 0])
    >>> lens.distort(np.array([[100.0, 100.0]])).round(2)
    array([[111.97, 107.62]])
    >>> lens.undistort(lens.distort(np.array([[100.0, 100.0]]))).round(6)
    array([[100., 100.]])
    """

    def __init__(self, camera_matrix: ArrayLike, distortion: ArrayLike, fisheye: bool = False) -> None:
        self._matrix = matrix = np.array(camera_matrix, np.float64)
        self._distortion = np.array(distortion, np.float64).ravel()
        self._fisheye = fisheye
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError(f"required a finite 3 x 3 camera_matrix, got {matrix.tolist()}")
        form = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
        if min(matrix[0, 0], matrix[1, 1]) <= 0 or not np.array_equal(matrix, form):
            raise ValueError(
                "required camera_matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with focal lengths fx, fy > 0 "
                f"px, got {matrix.tolist()}"
            )
        lengths, model = _COEFFICIENT_COUNTS[fisheye], "fisheye" if fisheye else "polynomial"
        if len(self._distortion) not in lengths or not np.isfinite(self._distortion).all():
            raise ValueError(
                f"required {' or '.join(map(str, lengths))} finite distortion coefficients of the {model} "
                f"model, got {self._distortion.tolist()}"
            )

    def distort(self, points: Floats) -> Floats:
        """Where the lens puts points of the undistorted frame: (N, 2) float64 px -> (N, 2) float64 px."""
        if len(points) == 0:
            return points.copy()
        rays = (points - self._matrix[:2, 2]) / self._matrix[[0, 1], [0, 1]]
        if self._fisheye:
            bent = cv2.fisheye.distortPoints(rays[:, None], self._matrix, self._distortion)
        else:
            rays, nothing = np.column_stack([rays, np.ones(len(rays))]), np.zeros(3)
            bent, _ = cv2.projectPoints(rays[:, None], nothing, nothing, self._matrix, self._distortion)
        return np.asarray(bent, np.float64).reshape(-1, 2)

    def undistort(self, points: Floats) -> Floats:
        """Inverse of `distort`: (N, 2) float64 px -> (N, 2) float64 px.

        For a point that no undistorted point maps to, the result is arbitrary.
        """
        if len(points) == 0:
            return points.copy()
        undistort = cv2.fisheye.undistortPoints if self._fisheye else _undistort
        straight = undistort(
            points[:, None],
            self._matrix,
            self._distortion,
            R=np.eye(3),
            P=self._matrix,
            criteria=_STOPPING_CRITERIA,
        )
        return np.asarray(straight, np.float64).reshape(-1, 2)
