"""Scale from a picture of a printed target, a checkerboard or a grid of dots, which OpenCV finds.

The target lies where the gel's surface is: seen through a clear gel, or before the gel is put on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.scale import centre
from tactflow.vision.arrays import Points
from tactflow.vision.types import Scale

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
