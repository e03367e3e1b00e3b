"""The slope of the gel's surface from its colour.

A matt surface reflects each coloured light in proportion to the cosine between its normal and the light, so
that the horizontal part of the normal is linear in the relative change of the three channels. Shadows, gloss
and near light make it a smooth function of the colour that varies with the place: here a cubic polynomial in
the colour, without a constant, since no change is no slope, whose coefficients are quadratic polynomials of
the place. Nothing is learned at run time.

A cubic is arbitrary beyond the range of the fit. Normals steeper than any part of the balls are therefore
those of a matt surface: along the line from no change to the colour of the pixel, they grow in proportion
from where they are as steep as the balls. Fitted to the middle of balls (0.35 of the radius), this reduces
the error of the normals outside of it from 9.7 to 7.9 degrees on mini_ball, and from 2.2 to 2.0, 17.9 to 17.7
and 22.7 to 22.1 on the others.

References
----------
M. Johnson and E. Adelson, "Retrographic sensing for the measurement of surface texture and shape", CVPR 2009;
W. Yuan, S. Dong, E. Adelson, "GelSight", Sensors 2017, for photometric stereo by calibration with a ball.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Bytes, Floats32, Indices
from tactflow.vision.compiled import kernel

BAND_ROWS: Final = 8
"""Rows that are computed over the same columns. Chosen by hand: to find the columns of each row would take
four times as long."""
MAX_HORIZONTAL_PART: Final = 0.95
"""Largest horizontal part of a unit normal: a slope of 3. Steeper slopes have no colour of their own."""
BISECTION_COUNT: Final = 12
"""Bisections that locate a point on a line of colours to 1 / 4096 of its length."""

TERM_FACTORS: Final = np.array(
    (
        *((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)),
        *((0, 3), (0, 4), (0, 5), (0, 6), (0, 7), (0, 8), (1, 6), (1, 7), (1, 8), (2, 8)),
    )
)
"""Pairs of terms of the colour whose product is the fourth term, the fifth, ...; the first three are the
channels."""
COLOUR_TERMS: Final = 19
"""Products of one to three of the three channels."""
PLACE_TERMS: Final = 6
"""Products of none to two of the two coordinates."""


class SlopeModel:
    """Slopes of the gel's surface from relative changes of its colour.

    Raises ValueError on another shape, or on numbers that are not finite.

    Parameters
    ----------
    coefficients : (6, 19, 2): for each term of the place and of the colour, x and y of the normal.

    Examples
    --------
    >>> model = SlopeModel(np.zeros((PLACE_TERMS, COLOUR_TERMS, 2)))
    >>> everywhere = np.ones((1, 5), np.uint8)
    >>> model.slopes(np.ones((4, 5, 3), np.float32), *coordinates((5, 4)), everywhere).shape
    (2, 4, 5)
    """

    def __init__(self, coefficients: NDArray[np.floating]) -> None:
        wanted = (PLACE_TERMS, COLOUR_TERMS, 2)
        if coefficients.shape != wanted or not np.isfinite(coefficients).all():
            raise ValueError(f"slopes: required finite coefficients {wanted}, got {coefficients.shape}")
        self.coefficients: Floats32 = np.asarray(coefficients, np.float32)
        self._by_place = np.ascontiguousarray(self.coefficients.transpose(2, 1, 0))

    def zoomed(self, across: float, down: float) -> SlopeModel:
        """The same for pictures that show another part of the gel, with the same centre.

        across, down : width and height of that part, over those of the pictures that the model is for.

        >>> terms = np.ones((PLACE_TERMS, COLOUR_TERMS, 2))
        >>> SlopeModel(terms).zoomed(0.5, 1.0).coefficients[:, 0, 0].tolist()
        [1.0, 0.5, 1.0, 0.25, 0.5, 1.0]
        """
        factors = np.array([1, across, down, across**2, across * down, down**2], np.float32)
        return SlopeModel(self.coefficients * factors[:, None, None])

    def slopes(
        self, change: Floats32, x: Floats32, y: Floats32, near: Bytes, steepest: float = MAX_HORIZONTAL_PART
    ) -> Floats32:
        """(2, h, w) float32: how much the surface rises to the right, and down, towards the camera.

        change : (h, w, 3) float32, change of the light over the light at rest. x : (w,), y : (h,) float32,
        `coordinates` of the pixels. near : (bands, w) uint8, one row for `BAND_ROWS` rows: slopes are
        computed from its first column that is not 0 to the last; elsewhere they are 0. steepest :
        horizontal part of a unit normal up to which the polynomial holds, `SurfaceErrors.steepest`.
        """
        slope = np.zeros((2, *change.shape[:2]), np.float32)
        slopes_of_colour(
            change,
            self._by_place,
            x,
            y,
            near,
            steepest,
            slope,
            BAND_ROWS,
            BISECTION_COUNT,
            MAX_HORIZONTAL_PART,
        )
        return slope


@kernel
def slopes_of_colour(
    change: Floats32,
    coefficients: Floats32,
    x: Floats32,
    y: Floats32,
    near: Bytes,
    steepest: float,
    slope: Floats32,
    band: int,
    halvings: int,
    most: float,
) -> None:
    """Fill `slope`, (2, h, w) of 0, with the slopes of the pixels near the contact.

    change, x, y, near, steepest : of `SlopeModel.slopes`. coefficients : (2, 19, 6). band : rows per row of
    `near`. halvings : of the search for `steepest`. most : largest horizontal part of a unit normal.
    """
    dtype = coefficients.dtype
    for row in range(len(y)):
        columns = np.flatnonzero(near[row // band])
        if not len(columns):
            continue
        part = slice(columns[0], columns[-1] + 1)
        terms = colour_terms(change[row, part]).astype(dtype)
        parts = terms * (coefficients @ _place_products(x[part], np.full_like(x[part], y[row])))
        # The parts of the normals of the first degree, of the first two, and of all.
        first, second, normal = parts[:, :3].sum(axis=1), parts[:, :9].sum(axis=1), parts.sum(axis=1)
        steep = (normal**2).sum(axis=0) > steepest**2
        if steep.any():
            normal[:, steep] = _beyond(
                first[:, steep], second[:, steep], normal[:, steep], steepest, halvings
            )
        length = np.sqrt((normal**2).sum(axis=0))
        flat = np.minimum(length, most)
        slope[:, row, part] = normal * (flat / (np.maximum(length, 1e-9) * np.sqrt(1 - flat**2)))


def _beyond(first: Floats32, second: Floats32, normal: Floats32, steepest: float, halvings: int) -> Floats32:
    """Normals (2, n) in proportion to where, on the line of colours from no change, they are as steep as
    `steepest`.

    first, second, normal : (2, n), of the terms up to the first and the second degree, and of all.
    """
    low, high = np.zeros_like(normal[0]), np.ones_like(normal[0])
    found = normal
    for _ in range(halvings):
        t = (low + high) / 2
        found = first + t * (second - first + t * (normal - second))
        steep = t * t * (found**2).sum(axis=0) > steepest**2
        high, low = np.where(steep, t, high), np.where(steep, low, t)
    return found


def colour_terms(change: Floats32, factors: Indices = TERM_FACTORS) -> Floats32:
    """(19, n) float32: all products of one to three channels of (..., 3), pixel by pixel.

    >>> float(colour_terms(np.full((1, 1, 3), 2, np.float32)).sum())
    110.0
    """
    terms = np.empty((COLOUR_TERMS, change.size // 3), np.float32)
    terms[:3] = change.reshape(-1, 3).T
    for term, (one, other) in zip(terms[3:], factors, strict=True):
        np.multiply(terms[one], terms[other], out=term)
    return terms


def coordinates(size: tuple[int, int]) -> tuple[Floats32, Floats32]:
    """(width,) and (height,) float32: x and y of the columns and rows, from -1 to 1 across the picture.

    size : (width, height), px.
    """
    across, down = (np.linspace(-1, 1, side, dtype=np.float32) for side in size)
    return across, down


def place_terms(size: tuple[int, int]) -> Floats32:
    """(6, h, w) float32: 1, x, y, x^2, x y, y^2 of every pixel, from -1 to 1 across the picture.

    size : (width, height), px.

    >>> place_terms((3, 2))[1].tolist()
    [[-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]]
    """
    return _place_products(*np.meshgrid(*coordinates(size)))


def _place_products(x: Floats32, y: Floats32) -> Floats32:
    """(6, ...): 1, x, y, x^2, x y and y^2 of coordinates (...)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
