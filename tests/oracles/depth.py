"""Plain versions of the kernels that make heights of colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.depth.poisson import _frequencies, solve_columns
from tactflow.vision.depth.slopes import BAND, STEEPEST, colour_terms, coordinates, slopes_of_colour
from tests.oracles.gains import Gain
from tests.oracles.typical import Arguments

Float = NDArray[np.float32]
Bytes = NDArray[np.uint8]

SIZE = 66, 70
"""Rows and columns, about those of the window around the deepest contact of the scene `press`."""


def plain_slopes_of_colour(
    change: Float, coefficients: Float, x: Float, y: Float, near: Bytes, slope: Float
) -> None:
    """The polynomial term by term, cut, from the first column of each band to the last."""
    across, down = np.meshgrid(x, y)
    place = np.stack([np.ones_like(across), across, down, across**2, across * down, down**2])
    colour = colour_terms(change).reshape(-1, *place.shape[1:])
    normal = np.einsum("pyx,cyx,kcp->kyx", place, colour, coefficients)
    normal *= np.minimum(1, STEEPEST / np.maximum(np.hypot(*normal), 1e-9))
    for row in range(len(y)):
        columns = np.flatnonzero(near[row // BAND])
        if len(columns):
            part = (slice(None), row, slice(columns[0], columns[-1] + 1))
            slope[part] = normal[part] / np.sqrt(1 - (normal[part] ** 2).sum(axis=0))


def plain_solve_columns(values: Float, stiffness: Float, turn: Float) -> None:
    """The matrix of each column, inverted; the constant of the first one is known by its last value."""
    values[:] = _mirrored(values, turn)
    height = len(values)
    second = np.diag(np.full(height, -2.0)) + np.eye(height, k=1) + np.eye(height, k=-1)
    second[0, 0] = second[-1, -1] = -1
    for column, more in enumerate(stiffness.astype(np.float64)):
        matrix, given = second - more * np.eye(height), values[:, column].astype(np.float64)
        if column == 0:
            matrix[-1], given[-1] = np.eye(height)[-1], 0
        values[:, column] = np.linalg.solve(matrix, given)
    values[:] = _mirrored(values, turn)


def _mirrored(values: Float, turn: Float) -> Float:
    mirrored = values.copy()
    end = 2 * turn.shape[1] + 1
    one, other = values[:, 1:end:2], values[:, 2:end:2]
    mirrored[:, 1:end:2] = turn[0] * one + turn[1] * other
    mirrored[:, 2:end:2] = turn[1] * one - turn[0] * other
    return mirrored


def _colours() -> Arguments:
    rng = np.random.default_rng(1)
    height, width = SIZE
    change = rng.normal(0, 0.2, (height, width, 3)).astype(np.float32)
    coefficients = rng.normal(0, 0.3, (2, 19, 6)).astype(np.float32)
    near = np.zeros((-(-height // BAND), width), np.uint8)
    near[1:-1, 5:-7] = 255
    slope = np.zeros((2, height, width), np.float32)
    return change, coefficients, *coordinates((width, height)), near, slope


def _spectrum() -> Arguments:
    values = np.random.default_rng(2).normal(0, 1, SIZE).astype(np.float32)
    return values, *_frequencies(SIZE[1])


GAINS = [
    # Sums of 114 products in another order.
    Gain(slopes_of_colour, plain_slopes_of_colour, tolerance=2e-5, arguments=_colours),
    # Numbers of up to some hundred.
    Gain(solve_columns, plain_solve_columns, tolerance=5e-4, arguments=_spectrum),
]
