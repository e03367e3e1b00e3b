"""The surface that has given slopes."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]


def integrate(slope_x: Float, slope_y: Float) -> Float:
    """Heights whose slopes come closest to the given ones, in least squares, up to a constant.

    Poisson's equation with free borders, solved by the cosine transform, in which it is diagonal.

    Parameters
    ----------
    slope_x, slope_y : (h, w) float32, growth per pixel to the right and down; h and w even.

    Returns
    -------
    (h, w) float32 with mean 0, in the unit of the slopes.

    References
    ----------
    T. Simchony, R. Chellappa, M. Shao, "Direct analytical methods for solving Poisson equations in computer
    vision problems", PAMI 12 (1990).

    Examples
    --------
    >>> heights = integrate(np.full((4, 6), 2, np.float32), np.zeros((4, 6), np.float32))
    >>> np.round(heights[0], 3).tolist()
    [-5.0, -3.0, -1.0, 1.0, 3.0, 5.0]
    """
    # Between two pixels the surface rises by the mean of their slopes.
    across = (slope_x[:, 1:] + slope_x[:, :-1]) * np.float32(0.5)
    down = (slope_y[1:] + slope_y[:-1]) * np.float32(0.5)
    divergence = np.zeros(slope_x.shape, np.float32)
    divergence[:, :-1] += across
    divergence[:, 1:] -= across
    divergence[:-1] += down
    divergence[1:] -= down
    spectrum = np.asarray(cv2.dct(divergence), np.float32) * _inverse_laplacian(slope_x.shape)
    return np.asarray(cv2.idct(spectrum), np.float32)


@lru_cache(maxsize=64)
def _inverse_laplacian(shape: tuple[int, int]) -> Float:
    """(h, w) float32: one over the eigenvalues of the Laplacian; 0 for the constant."""
    rows, columns = (2 * np.cos(np.pi * np.arange(side) / side) - 2 for side in shape)
    eigenvalues = rows[:, None] + columns
    eigenvalues[0, 0] = 1
    inverse = 1 / eigenvalues
    inverse[0, 0] = 0
    inverse.setflags(write=False)
    return np.asarray(inverse, np.float32)
