"""The similarity (shift, turn and growth) that best fits vectors at places in the plane.

Places and vectors are complex numbers, x + iy, so that a similarity is a line.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats

Complexes = NDArray[np.complex128]
_MIN_SPREAD: Final = 1e-9
"""Smallest mean square distance from the middle that is divided by, in squared units."""


class Similarity(NamedTuple):
    """Vectors as mean + slope * away, by weighted least squares.

    Attributes
    ----------
    middle : weighted mean of the places.
    mean : that of the vectors.
    slope : growth + i turn, from +x to +y, where the vectors are displacements.
    away : (n,), places from the middle.
    spread : weighted mean of its squares.
    """

    middle: complex
    mean: complex
    slope: complex
    away: Complexes
    spread: float


def fit_similarity(places: Complexes, vectors: Complexes, weights: Floats) -> Similarity:
    """Fit a similarity. places, vectors, weights : (n,); the weights have the sum 1.

    >>> corners = np.array([0, 1, 1 + 1j, 1j])
    >>> fit_similarity(corners, 2 + 0.5j * corners, np.full(4, 0.25)).slope
    0.5j
    """
    middle, mean = complex(weights @ places), complex(weights @ vectors)
    away = places - middle
    weighted = weights * away.conj()
    spread = float((weighted @ away).real)
    return Similarity(middle, mean, complex(weighted @ vectors) / max(spread, _MIN_SPREAD), away, spread)


def as_complex(pairs: Floats) -> Complexes:
    """(n,): vectors (n, 2) as x + iy."""
    return np.ascontiguousarray(pairs).view(np.complex128)[:, 0]
