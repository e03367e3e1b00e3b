"""Least-squares similarity between two sets of points: mean shift, rotation, growth."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

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
    sums = np.empty(7)
    sum_similarity(np.ascontiguousarray(origin), np.ascontiguousarray(position), chosen, sums)
    mean_x, mean_y, fitted, growth_x, growth_y, rest_x, rest_y = sums.tolist()
    return Similarity(mean_x, mean_y, bool(fitted), growth_x, growth_y, rest_x, rest_y)


@kernel("void(float64[:, ::1], float64[:, ::1], int64[::1], float64[::1])")
def sum_similarity(
    origin: FloatArray, position: FloatArray, chosen: NDArray[np.intp], sums: FloatArray
) -> None:
    """Set `sums` (7,) to the fields of `Similarity`, in their order."""
    count = chosen.size
    at_x = at_y = mean_x = mean_y = 0.0
    for index in chosen:
        at_x, at_y = at_x + origin[index, 0], at_y + origin[index, 1]
        mean_x += position[index, 0] - origin[index, 0]
        mean_y += position[index, 1] - origin[index, 1]
    at_x, at_y, mean_x, mean_y = at_x / count, at_y / count, mean_x / count, mean_y / count
    xx = xy = yy = along = across = 0.0
    for index in chosen:
        x, y = origin[index, 0] - at_x, origin[index, 1] - at_y
        u = position[index, 0] - origin[index, 0] - mean_x
        v = position[index, 1] - origin[index, 1] - mean_y
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
        along, across = along + x * u + y * v, across + x * v - y * u
    fitted = count >= 3 and xx * yy - xy * xy > _FLAT * _FLAT * (xx + yy) * (xx + yy)
    growth_x, growth_y = (along / (xx + yy), across / (xx + yy)) if fitted else (0.0, 0.0)
    rest_x = rest_y = 0.0
    for index in chosen:
        x, y = origin[index, 0] - at_x, origin[index, 1] - at_y
        u = position[index, 0] - origin[index, 0] - mean_x - (growth_x * x - growth_y * y)
        v = position[index, 1] - origin[index, 1] - mean_y - (growth_y * x + growth_x * y)
        rest_x, rest_y = rest_x + u * u, rest_y + v * v
    sums[0], sums[1], sums[2], sums[3], sums[4] = mean_x, mean_y, fitted, growth_x, growth_y
    sums[5], sums[6] = rest_x, rest_y
