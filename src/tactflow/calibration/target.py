"""Lens, perspective and scale from pictures of a printed target: a checkerboard, or a grid of dots.

The target is seen where the gel's surface is: through a clear gel, or before the gel is put on. OpenCV finds
it and fits the lens.

References
----------
Z. Zhang, "A flexible new technique for camera calibration", PAMI 22 (2000), as `cv2.calibrateCamera` has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.scale import centre
from tactflow.vision.arrays import Points
from tactflow.vision.geometry.homography import find_homography, project
from tactflow.vision.geometry.lens import Lens
from tactflow.vision.types import Scale

FEWEST_VIEWS: Final = 6
"""Pictures in different poses that a lens needs at least; 10 or more are better. Chosen by hand."""
FEWEST_POINTS: Final = 3
"""Columns and rows of a target at least: OpenCV finds none with fewer."""
BENT: Final = 0.01
"""How far the points may lie off a plane grid, in pitches, before the picture is called bent. By hand."""


@dataclass(frozen=True, slots=True)
class Target:
    """What was printed. columns, rows : of inner corners of a checkerboard, or of dots. pitch : mm."""

    columns: int
    rows: int
    pitch: float
    dots: bool = False

    @property
    def places(self) -> Points:
        """(N, 2) float64, mm, row by row.

        >>> Target(2, 2, 5.0).places.tolist()
        [[0.0, 0.0], [5.0, 0.0], [0.0, 5.0], [5.0, 5.0]]
        """
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return self.pitch * np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def find_target(image: NDArray[np.uint8], target: Target) -> Points | None:
    """(N, 2) float64, px: the points of a target, row by row; None where not all of it is seen.

    image : (H, W, 3) uint8, BGR.

    Raises ValueError if the target has too few columns or rows, or no pitch.
    """
    if min(target.columns, target.rows) < FEWEST_POINTS:
        raise ValueError(f"target: required {FEWEST_POINTS} columns and rows or more")
    if not (np.isfinite(target.pitch) and target.pitch > 0):
        raise ValueError(f"target: required a pitch > 0 mm, got {target.pitch:g}")
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    size = (target.columns, target.rows)
    if target.dots:
        found, points = cv2.findCirclesGrid(grey, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID)
    else:
        found, points = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    grid = np.asarray(points, np.float64).reshape(target.rows, target.columns, 2)
    # A target looks the same when it is turned by 180 degrees: x grows to the right, y down.
    grid = grid[:, ::-1] if (grid[:, -1] - grid[:, 0]).mean(axis=0)[0] < 0 else grid
    grid = grid[::-1] if (grid[-1] - grid[0]).mean(axis=0)[1] < 0 else grid
    return grid.reshape(-1, 2)


def scale_from_target(points: Points, target: Target, size: tuple[int, int]) -> tuple[Scale, float]:
    """Scale from a target that lies in the plane of the gel, however it is turned.

    points : (N, 2), px of the processed frame, as `find_target` gives them. size : (width, height) of that.

    Returns
    -------
    The scale, and the RMS distance of the points from a plane grid without perspective, in pitches: beyond
    `BENT` no single scale is right for all of the picture. The standard errors come from that distance.

    Examples
    --------
    >>> target = Target(4, 3, 2.0)
    >>> scale, bent = scale_from_target(target.places * 10 + 5, target, (100, 80))
    >>> round(scale.x, 6), round(scale.y, 6), round(bent, 6)
    (0.1, 0.1, 0.0)
    """
    matrix = np.column_stack([points, np.ones(len(points))])
    solved = np.linalg.lstsq(matrix, target.places, rcond=None)[0]
    left = target.places - matrix @ solved
    along = np.linalg.norm(solved[:2], axis=1)
    variance = float((left**2).sum()) / (2 * len(points) - 6)
    spread = np.sqrt(variance * np.diag(np.linalg.inv(matrix.T @ matrix)))
    bent = float(np.sqrt(np.mean((left**2).sum(axis=1)))) / target.pitch
    return Scale(float(along[0]), float(along[1]), (float(spread[0]), float(spread[1])), centre(size)), bent


@dataclass(frozen=True, eq=False, slots=True)
class LensFit:
    """A lens. rms : distance of the points from where it puts them, px. stderr : (4,) float64 of fx, fy, cx,
    cy, px. corners, places, size : the homography of the first picture, see `preprocess`."""

    lens: Lens
    rms: float
    stderr: Points
    corners: Points
    places: Points
    size: tuple[int, int]


def fit_lens(views: Sequence[Points], target: Target, size: tuple[int, int]) -> LensFit:
    """The lens from a target in several poses, and the homography that rectifies the first of them.

    views : (N, 2) each, raw px, as `find_target` gives them; the first lies in the plane of the gel. size :
    (width, height) of the raw frame.

    Raises
    ------
    ValueError : too few views.
    """
    if len(views) < FEWEST_VIEWS:
        raise ValueError(
            f"lens: required {FEWEST_VIEWS} pictures with the whole target or more, tilted to all sides, "
            f"found {len(views)}"
        )
    solid = np.column_stack([target.places, np.zeros(len(target.places))]).astype(np.float32)
    pixels = [view.astype(np.float32) for view in views]
    # The sixth power of the radius is told apart from the fourth only by lenses that see very wide.
    rms, matrix, distortion, _, _, spread, _, _ = cv2.calibrateCameraExtended(
        [solid] * len(pixels), pixels, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
    )
    lens = Lens(np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).ravel())
    corners, places, rectified = _rectified(lens.undistort(views[0]), target, size)
    stderr = np.asarray(spread, np.float64).ravel()[:4]
    return LensFit(lens, float(rms), stderr, corners, places, rectified)


def _rectified(
    points: Points, target: Target, size: tuple[int, int]
) -> tuple[Points, Points, tuple[int, int]]:
    """Four corners of the target (4, 2), where they go (4, 2), and the size that holds the frame, px."""
    last = target.columns * target.rows - 1
    outer = [0, target.columns - 1, last, last - target.columns + 1]
    corners, flat = points[outer], target.places[outer]
    steps = np.linalg.norm(np.diff(points.reshape(target.rows, target.columns, 2), axis=1), axis=2)
    places = flat * float(np.median(steps)) / target.pitch
    matrix = find_homography(corners.tolist(), places.tolist())
    width, height = size
    frame = np.array([[0.0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    moved = project(matrix, frame)
    low, high = moved.min(axis=0), moved.max(axis=0)
    return corners, places - low, (int(np.ceil(high[0] - low[0])) + 1, int(np.ceil(high[1] - low[1])) + 1)
