"""Plain version of the least-squares similarity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.similarity import sum_similarity
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]

FLAT = 1e-3
"""Spread of the points across a line over that along it, 1, up to which they do not span a plane."""


def plain_sum_similarity(
    origin: FloatArray, position: FloatArray, chosen: NDArray[np.intp], sums: FloatArray
) -> None:
    """Mean displacement, whether the points span a plane, growth less 1, and squares of what is left."""
    grid = origin[chosen]
    left = position[chosen] - grid
    mean = left.mean(axis=0)
    left -= mean
    grid -= grid.mean(axis=0)
    growth = np.zeros(2)
    x, y = grid.T
    squares = float(x @ x), float(y @ y)
    scatter = squares[0] + squares[1]
    # Product over squared sum of the principal scatters; about their ratio where one is small.
    fitted = len(grid) >= 3 and squares[0] * squares[1] - float(x @ y) ** 2 > FLAT**2 * scatter**2
    if fitted:
        growth = np.array([x @ left[:, 0] + y @ left[:, 1], x @ left[:, 1] - y @ left[:, 0]]) / scatter
        left -= np.column_stack([growth[0] * x - growth[1] * y, growth[1] * x + growth[0] * y])
    sums[:] = [*mean, fitted, *growth, *(left * left).sum(axis=0)]


# Sums of some 30 numbers of up to 2e2 px in doubles, in another order; squares of them.
GAINS = [Gain(sum_similarity, plain_sum_similarity, tolerance=1e-10)]
