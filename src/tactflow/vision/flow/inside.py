"""Which points lie in a mask, or near it."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Flags, Mask, Points, check_mask
from tactflow.vision.flow.loops import look_up

_ROUNDING: Final = 1e-9
"""Added to the squared reach, px^2, so that a pixel exactly at the reach counts. Chosen by hand."""
_FARTHEST: Final = 1e9
"""Coordinates, px, that stand for those farther out, whose squares might overflow. Chosen by hand."""


def inside_mask(points: Points, mask: Mask, dilate: float = 0.0) -> Flags:
    """Which points fall on a pixel that has a pixel of the mask within `dilate` px.

    Parameters
    ----------
    points : (N, 2) float, px, x right, y down; those outside the frame are judged by their distance, too.
    mask : (H, W) uint8, not 0 inside.
    dilate : px, >= 0, between pixel centres.

    Returns
    -------
    (N,) bool.

    Raises
    ------
    ValueError : mask is not (H, W) uint8, or dilate is negative or not finite.

    Examples
    --------
    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:10, 5:10] = 255
    >>> inside_mask(np.array([[7.2, 7.0], [12.0, 7.0], [15.0, 7.0]]), mask, dilate=3)
    array([ True,  True, False])
    """
    check_mask(mask)
    if not (dilate >= 0 and math.isfinite(dilate)):
        raise ValueError(f"required dilate >= 0 px, got {dilate}")
    inside = np.zeros(len(points), np.bool_)
    look_up(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(mask), inside)
    contours = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0] if dilate else ()
    if contours:
        # The pixel of the mask that is nearest to a point outside is one of its border.
        border = np.concatenate(contours)[:, 0]
        outside, (x, y) = np.flatnonzero(~inside), np.clip(np.rint(points), -_FARTHEST, _FARTHEST).T
        away_x, away_y = x[outside, None] - border[:, 0], y[outside, None] - border[:, 1]
        nearest = (away_x * away_x + away_y * away_y).min(axis=1)
        inside[outside] = nearest <= min(dilate, 1e150) ** 2 + _ROUNDING
    return inside
