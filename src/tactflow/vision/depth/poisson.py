"""The surface with measured slopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, Final

import numpy as np
import scipy.fft

from tactflow.vision.arrays import Floats32
from tactflow.vision.compiled import kernel

_Transform = Callable[..., Any]

Sides = tuple[tuple[bool, bool], tuple[bool, bool]]
"""Whether the surface goes on beyond the left and right, and beyond the top and bottom; else it is at rest
there, at height 0."""
ALL_OPEN: Final = ((True, True), (True, True))
_TRANSFORMS: Final[Mapping[tuple[bool, bool], tuple[_Transform, _Transform, int, float]]] = {
    (True, True): (scipy.fft.dct, scipy.fft.idct, 2, 0.0),
    (True, False): (scipy.fft.dct, scipy.fft.idct, 4, 0.5),
    (False, True): (scipy.fft.dst, scipy.fft.idst, 4, 0.5),
    (False, False): (scipy.fft.dst, scipy.fft.idst, 2, 1.0),
}
"""Whether the first and the last side of the rows are open -> transform, its inverse, their type, and the
frequency of the first component, in half waves. All of them mirror the surface half a pixel outside: as it is
where it goes on, upside down where it is at rest."""
MIRROR_IMAGE: Final = {True: 1, False: -1}
"""Whether a side is open -> the pixel beyond it, over the last one before it."""
LEAST_EIGENVALUE: Final = -1e-9
"""Instead of 0, for a surface whose mean the slopes do not tell: then the mean is near 0."""


def integrate(
    slope: Floats32, step: tuple[float, float], sides: Sides = ((False, False), (False, False))
) -> Floats32:
    """Heights whose slopes are closest to the measured ones, in least squares.

    Poisson's equation, solved by a cosine or sine transform of the rows, and elimination down the columns.
    Where all sides are open the mean height is 0.

    Parameters
    ----------
    slope : (2, h, w) float32, growth to the right and down, h and w at least 2; quick where w is a product
        of 2, 3 and 5.
    step : from a pixel to the next one, to the right and down, in the unit of the heights.
    sides : open ones.

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
    >>> np.round(integrate(slope, (0.5, 0.5), ALL_OPEN)[0], 3).tolist()
    [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    >>> np.round(integrate(slope, (0.5, 0.5), ((False, True), (True, True)))[0], 3).tolist()
    [0.5, 1.5, 2.5, 3.5, 4.5, 5.5]
    """
    transform, back, type_, first = _TRANSFORMS[sides[0]]
    left, right, top, bottom = (MIRROR_IMAGE[end] for pair in sides for end in pair)
    spectrum: Floats32 = np.empty(slope.shape[1:], np.float32)
    divergence(np.ascontiguousarray(slope), *step, left, right, top, bottom, spectrum)
    spectrum = transform(spectrum, type_, axis=1, norm="ortho", overwrite_x=True)
    solve_down(spectrum, _eigenvalues(spectrum.shape[1], first), top, bottom)
    if sides == ALL_OPEN:
        spectrum[:, 0] -= spectrum[:, 0].mean()
    return np.asarray(back(spectrum, type_, axis=1, norm="ortho", overwrite_x=True), np.float32)


@lru_cache(maxsize=256)
def _eigenvalues(count: int, first: float) -> Floats32:
    """(count,): of the second difference, for the components of a transform."""
    exact = 2 * np.cos(np.pi * (np.arange(count) + first) / count) - 2
    return np.asarray(np.minimum(exact, LEAST_EIGENVALUE), np.float32)


@kernel
def solve_down(plane: Floats32, shift: Floats32, top: float, bottom: float) -> None:
    """Solve a tridiagonal system in each column: second difference down plus `shift` times the solution.

    plane : (h, w), the right sides, replaced by the solutions; h at least 2. shift : (w,), < 0. top, bottom :
    the pixel beyond these sides, over the last one before them, see `MIRROR_IMAGE`.
    """
    middle = np.add.outer(np.full(len(plane), -2.0), shift)
    middle[0] += top
    middle[-1] += bottom
    side = plane.astype(np.float64)
    for row in range(1, len(plane)):
        side[row] -= side[row - 1] / middle[row - 1]
        middle[row] -= 1 / middle[row - 1]
    side[-1] /= middle[-1]
    for row in range(len(plane) - 2, -1, -1):
        side[row] = (side[row] - side[row + 1]) / middle[row]
    plane[:] = side


@kernel
def divergence(
    slope: Floats32,
    across: float,
    along: float,
    left: float,
    right: float,
    top: float,
    bottom: float,
    total: Floats32,
) -> None:
    """By how much more the surface rises behind each pixel than before it, in both directions.

    Between two pixels it rises by the mean of their slopes; beyond an open side the slope is that of the
    mirror image, and beyond a side at rest that of the mirror image upside down.

    slope : (2, h, w), growth to the right and down; h and w at least 2. across, along : steps, see
    `integrate`. left, ... : see `MIRROR_IMAGE`. total : (h, w), filled.
    """
    x, y = slope[0] * (across / 2), slope[1] * (along / 2)
    total[1:-1] = y[2:] - y[:-2]
    total[0] = y[1] + top * y[0]
    total[-1] = -y[-2] - bottom * y[-1]
    total[:, 1:-1] += x[:, 2:] - x[:, :-2]
    total[:, 0] += x[:, 1] + left * x[:, 0]
    total[:, -1] -= x[:, -2] + right * x[:, -1]
