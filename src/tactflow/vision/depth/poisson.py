"""The surface that has given slopes."""

from __future__ import annotations

import numpy as np
import scipy.fft

from tactflow.vision.arrays import Floats32


def integrate(slope: Floats32, step: tuple[float, float]) -> Floats32:
    """Heights whose slopes come closest to the given ones, in least squares; their mean is 0.

    Poisson's equation with free borders, solved by cosine transforms.

    Parameters
    ----------
    slope : (2, h, w) float32, growth to the right and down; quick where h and w are products of 2, 3 and 5.
    step : from a pixel to the next one, to the right and down, in the unit of the heights.

    Returns
    -------
    (h, w) float32.

    References
    ----------
    T. Simchony, R. Chellappa, M. Shao, "Direct analytical methods for solving Poisson equations in computer
    vision problems", PAMI 12 (1990).

    Examples
    --------
    >>> slope = np.stack([np.full((4, 6), 2, np.float32), np.zeros((4, 6), np.float32)])
    >>> np.round(integrate(slope, (0.5, 0.5))[0], 3).tolist()
    [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    """
    spectrum = scipy.fft.dctn(_divergence(slope, step), norm="ortho", overwrite_x=True)
    down, across = (2 * np.cos(np.pi * np.arange(side) / side) - 2 for side in spectrum.shape)
    eigenvalues = np.add.outer(down, across)
    # The mean is not known from slopes.
    eigenvalues[0, 0] = np.inf
    spectrum /= eigenvalues
    return np.asarray(scipy.fft.idctn(spectrum, norm="ortho", overwrite_x=True), np.float32)


def _divergence(slope: Floats32, step: tuple[float, float]) -> Floats32:
    """(h, w): by how much more the surface rises behind each pixel than before it.

    Between two pixels it rises by the mean of their slopes, beyond the border not at all.
    """
    slope_x, slope_y = slope
    across = (slope_x[:, 1:] + slope_x[:, :-1]) * np.float32(step[0] / 2)
    down = (slope_y[1:] + slope_y[:-1]) * np.float32(step[1] / 2)
    rise = np.diff(np.pad(across, ((0, 0), (1, 1))), axis=1) + np.diff(np.pad(down, ((1, 1), (0, 0))), axis=0)
    return np.asarray(rise, np.float32)
