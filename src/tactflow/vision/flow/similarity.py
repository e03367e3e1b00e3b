"""Least-squares similarity between two sets of points: mean shift, rotation, growth."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_FLAT: Final = 1e-3
"""Spread of the points across a line over that along it, 1, up to which they do not span a plane. Chosen by
hand."""


class Similarity(NamedTuple):
    """How points have moved.

    mean_x, mean_y : mean displacement, px.
    fitted : whether rotation and growth are known: three points or more that span a plane.
    growth_x, growth_y : the similarity as a complex number, less 1: its real part, and its imaginary part, a
        turn from +x to +y. 0 where they are not known.
    rest_x, rest_y : sums of the squares of what mean, rotation and growth leave unexplained, px^2.
    """

    mean_x: float
    mean_y: float
    fitted: bool
    growth_x: float
    growth_y: float
    rest_x: float
    rest_y: float


def fit_similarity(origin: FloatArray, position: FloatArray, chosen: NDArray[np.intp]) -> Similarity:
    """The similarity that takes `origin` to `position`, in closed form (Umeyama, 1991, by complex numbers).

    origin, position : (N, 2) float64, px. chosen : (n,) indices of the points that count, n >= 1.

    >>> origin = np.array([[0.0, 0], [10, 0], [0, 10]])
    >>> fit_similarity(origin, 1.1 * origin, np.arange(3)).growth_x.__round__(6)
    0.1
    """
    at = origin[chosen]
    rest = position[chosen] - at
    mean = rest.mean(axis=0)
    rest -= mean
    at -= at.mean(axis=0)
    x, y = at.T
    xx, yy = float(x @ x), float(y @ y)
    scatter = xx + yy
    # Product over squared sum of the principal scatters; about their ratio where one is small.
    fitted = len(at) >= 3 and xx * yy - float(x @ y) ** 2 > (_FLAT * scatter) ** 2
    growth_x = growth_y = 0.0
    if fitted:
        u, v = rest.T
        growth_x, growth_y = float(x @ u + y @ v) / scatter, float(x @ v - y @ u) / scatter
        rest -= np.column_stack([growth_x * x - growth_y * y, growth_y * x + growth_x * y])
    rest_x, rest_y = (rest * rest).sum(axis=0).tolist()
    return Similarity(float(mean[0]), float(mean[1]), fitted, growth_x, growth_y, rest_x, rest_y)
