"""The exact relation between the pixels of the raw and of the processed frame.

All coordinates have the centre of the top-left pixel at (0, 0). A k-fold block average therefore maps x to
(x - (k - 1) / 2) / k, while `cv2.pyrDown`, whose output pixel i is centred on input pixel 2 i, maps x to
x / 2: the two pictures look alike and lie half a raw pixel apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tactflow.vision.arrays import Floats
from tactflow.vision.geometry.homography import project
from tactflow.vision.geometry.lens import Lens


@dataclass(frozen=True, eq=False, slots=True)
class PixelMapping:
    """The exact relation between raw and processed pixel coordinates.

    raw_size, size : (width, height) of the raw and of the processed frame, px.
    matrix : (3, 3) float64, homogeneous, from undistorted raw to processed pixels.
    lens : what was taken out before, or None.

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
        pixels; points outside the frame are mapped all the same. Raises ValueError on another shape, or for
        coordinates that are not finite.
        """
        given = _points(points)
        raw = given.reshape(-1, 2)
        straight = raw if self.lens is None else self.lens.undistort(raw)
        return project(self.matrix, straight).reshape(given.shape)

    def to_raw(self, points: ArrayLike) -> Floats:
        """Where points of the processed frame lie in the raw frame: inverse of `to_processed`."""
        given = _points(points)
        straight = project(np.asarray(np.linalg.inv(self.matrix), np.float64), given.reshape(-1, 2))
        return (straight if self.lens is None else self.lens.distort(straight)).reshape(given.shape)


def shift(x: float, y: float) -> Floats:
    """Homogeneous matrix (3, 3) of a shift, px.

    >>> shift(3, -2)[:2, 2]
    array([ 3., -2.])
    """
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def rotation(rotate: int, size: tuple[int, int]) -> Floats:
    """Homogeneous matrix (3, 3) of `cv2.rotate` on a picture of size (width, height).

    rotate : 0, 90, 180 or 270 degrees clockwise.

    >>> rotation(90, (4, 3)) @ [0, 0, 1]
    array([2., 0., 1.])
    """
    width, height = size
    if rotate == 90:
        return np.array([[0.0, -1.0, height - 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if rotate == 180:
        return np.array([[-1.0, 0.0, width - 1.0], [0.0, -1.0, height - 1.0], [0.0, 0.0, 1.0]])
    if rotate == 270:
        return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, width - 1.0], [0.0, 0.0, 1.0]])
    return np.eye(3)


def _points(points: ArrayLike) -> Floats:
    given = np.asarray(points, dtype=np.float64)
    if given.ndim not in (1, 2) or given.shape[-1:] != (2,):
        raise ValueError(f"required points of shape (N, 2), got {given.shape}")
    if not np.isfinite(given).all():
        raise ValueError("required finite points, got NaN or infinity among them")
    return given
