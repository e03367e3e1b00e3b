"""The slope of the gel's surface from its colour.

A surface that tilts answers to each coloured light in proportion to the cosine between its normal and the
light, so that for a matt surface the horizontal part of the normal is linear in the relative change of the
three channels. Shadows, gloss and light from near make it a smooth function of the colour that differs from
place to place: here a cubic polynomial in the colour, without a constant, so that no change is no slope,
whose coefficients are quadratic polynomials of the place. Nothing of it is learned at run time.

References
----------
M. Johnson and E. Adelson, "Retrographic sensing for the measurement of surface texture and shape", CVPR 2009;
W. Yuan, S. Dong, E. Adelson, "GelSight", Sensors 2017, for photometric stereo by calibration with a ball.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]

STEEPEST: Final = 0.95
"""Horizontal part of a unit normal at most: a slope of 3. What is steeper has no colour of its own."""

COLOUR_TERMS: Final = 19
"""Products of one to three of the three channels."""
PLACE_TERMS: Final = 6
"""Products of none to two of the two coordinates."""

AT_ONCE: Final = 2048
"""Pixels that are computed at once: their terms stay in the processor's cache, which takes a third of the
time of all at once (0.14 ms instead of 0.45 ms for 76 x 76 pixels), and OpenBLAS starts no threads for such
products (below 2^18 multiplications), whose waiting for each other costs far more on a busy machine."""


class SlopeModel:
    """Normals of the gel's surface from relative changes of its colour.

    coefficients : (6, 19, 2): for each term of the place and of the colour, x and y of the normal.

    Raises ValueError on another shape, or on numbers that are not finite.

    >>> model = SlopeModel(np.zeros((PLACE_TERMS, COLOUR_TERMS, 2)))
    >>> model.normals(np.ones((3, 4, 5), np.float32), place_terms((5, 4))).shape
    (2, 4, 5)
    """

    def __init__(self, coefficients: NDArray[np.floating]) -> None:
        wanted = (PLACE_TERMS, COLOUR_TERMS, 2)
        if coefficients.shape != wanted or not np.isfinite(coefficients).all():
            raise ValueError(f"slopes: required finite coefficients {wanted}, got {coefficients.shape}")
        self.coefficients: Float = np.asarray(coefficients, np.float32)
        self._by_place = np.ascontiguousarray(self.coefficients.transpose(2, 0, 1))

    def normals(self, change: Float, place: Float) -> Float:
        """X and y of the unit normals.

        change : (3, h, w) float32, change of the light over the light at rest. place : (6, h, w) float32,
        `place_terms` of the same pixels. Returns (2, h, w) float32; positive where the surface rises to the
        right, and down, as seen by the camera: towards it. Steeper ones than `STEEPEST` are cut.
        """
        _, height, width = change.shape
        normal = np.empty((2, height, width), np.float32)
        rows = max(1, AT_ONCE // width)
        for top in range(0, height, rows):
            part = slice(top, top + rows)
            by_place = (self._by_place @ colour_terms(change[:, part])).reshape(2, PLACE_TERMS, -1, width)
            by_place *= place[:, part]
            np.sum(by_place, axis=1, out=normal[:, part])
        length = cv2.magnitude(normal[0], normal[1])
        normal /= np.maximum(length * np.float32(1 / STEEPEST), np.float32(1))
        return normal


def colour_terms(change: Float) -> Float:
    """(19, n) float32: all products of one to three channels of (3, ...), pixel by pixel.

    >>> float(colour_terms(np.full((3, 1, 1), 2, np.float32)).sum())
    110.0
    """
    terms = np.empty((COLOUR_TERMS, change[0].size), np.float32)
    terms[:3].reshape(change.shape)[:] = change
    blue, green, red = terms[:3]
    # Squares and products of two.
    np.multiply(blue, terms[:3], out=terms[3:6])
    np.multiply(green, terms[1:3], out=terms[6:8])
    np.multiply(red, red, out=terms[8])
    # Each of them times a channel that does not come before its own.
    np.multiply(blue, terms[3:9], out=terms[9:15])
    np.multiply(green, terms[6:9], out=terms[15:18])
    np.multiply(red, terms[8], out=terms[18])
    return terms


def place_terms(size: tuple[int, int]) -> Float:
    """(6, h, w) float32: 1, x, y, x^2, x y, y^2 of every pixel, from -1 to 1 across the picture.

    size : (width, height), px.

    >>> place_terms((3, 2))[1].tolist()
    [[-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]]
    """
    x, y = np.meshgrid(*(np.linspace(-1, 1, side, dtype=np.float32) for side in size))
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
