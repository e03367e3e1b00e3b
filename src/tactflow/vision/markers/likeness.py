"""How much spots look like the marks around them: normalized cross-correlation of what surrounds them."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats

WINDOW: Final = 2.6
"""Radius of the discs that are compared, in radii of the marks: they hold the gaps to the neighbours, too.
Chosen on sts_640 and sts_torque160, where glare correlates less with marks than with 1.9 radii."""

LEAST_WINDOW: Final = 2.0
"""Radius of these discs at least, px: smaller ones hold too few pixels to differ. Chosen by hand."""

SAMPLES: Final = 4
"""Samples along the radius of a disc. Chosen by hand."""


def likeness(gray: NDArray[np.float32], points: Floats, others: Floats, radius: Floats) -> Floats:
    """How much the discs around points look like those around others: mean correlation, -1 to 1.

    Brightness, contrast and the slope of the light play no part.

    Parameters
    ----------
    gray : (H, W) float32, grey levels.
    points : (n, 2) float64, px. others : (n, K, 2) float64, px, with which each is compared.
    radius : (n,) float64, of the marks there, px.

    Returns
    -------
    likeness : (n,) float64, mean over K; 0 for a disc on even ground.

    References
    ----------
    J. P. Lewis, "Fast normalized cross-correlation", Vision Interface (1995).

    Examples
    --------
    >>> gray = np.zeros((20, 40), np.float32)
    >>> gray[8:11, 8:11], gray[8:11, 28:31] = 50, 100
    >>> likeness(gray, np.array([[9.0, 9.0]]), np.array([[[29.0, 9.0]]]), np.array([1.5])).round(3)
    array([1.])
    """
    count, compared = others.shape[:2]
    if not count:
        return np.zeros(0)
    reach = np.maximum(WINDOW * radius, LEAST_WINDOW)
    own = _surroundings(gray, points, reach)
    theirs = _surroundings(gray, others.reshape(-1, 2), np.repeat(reach, compared))
    return np.asarray(np.einsum("np,nkp->nk", own, theirs.reshape(count, compared, -1)).mean(axis=1))


def _surroundings(gray: NDArray[np.float32], points: Floats, reach: Floats) -> Floats:
    """The levels of the discs around points (n, 2) without their mean and slope, as unit vectors (n, P)."""
    axis = np.linspace(-1, 1, 2 * SAMPLES + 1)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    inside = x * x + y * y <= 1
    x, y = x[inside], y[inside]
    column = (points[:, :1] + reach[:, None] * x).astype(np.float32)
    row = (points[:, 1:] + reach[:, None] * y).astype(np.float32)
    sampled = cv2.remap(gray, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    levels = sampled.astype(np.float64)
    plane, _ = np.linalg.qr(np.column_stack([np.ones_like(x), x, y]))
    levels -= levels @ plane @ plane.T
    return np.asarray(levels / np.maximum(np.linalg.norm(levels, axis=1, keepdims=True), 1e-9))
