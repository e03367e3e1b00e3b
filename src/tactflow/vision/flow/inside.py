"""Which points lie in a mask."""

from __future__ import annotations

import numpy as np

from tactflow.vision.arrays import Flags, Mask, Points, check_mask


def inside_mask(points: Points, mask: Mask) -> Flags:
    """Which points fall on a pixel of a mask.

    points : (N, 2) float, px, x right, y down. mask : (H, W) uint8, not 0 inside.
    Returns (N,) bool. Raises ValueError if mask is not (H, W) uint8.

    >>> mask = np.zeros((20, 20), np.uint8)
    >>> mask[5:10, 5:10] = 255
    >>> inside_mask(np.array([[7.2, 7.0], [9.4, 7.0], [9.6, 7.0]]), mask)
    array([ True,  True, False])
    """
    check_mask(mask)
    x, y = np.rint(points).T
    inside = (x >= 0) & (x < mask.shape[1]) & (y >= 0) & (y < mask.shape[0])
    inside[inside] = mask[y[inside].astype(np.intp), x[inside].astype(np.intp)] > 0
    return np.asarray(inside)
