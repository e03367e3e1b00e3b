"""Normals of a surface from its heights."""

from __future__ import annotations

import numpy as np

from tactflow.vision.arrays import Floats32
from tactflow.vision.types import Scale


def surface_normals(heights: Floats32, scale: Scale) -> Floats32:
    """Unit normals of the gel's surface, out of the gel.

    They belong to the gradient of the heights: central differences inside, one-sided ones at the border.
    Single slopes contradict each other where gloss, shadows or noise change the colour; the heights are the
    surface closest to all of them, so that their gradient is more accurate.

    Parameters
    ----------
    heights : (H, W) float32, how far the gel is pushed in, mm; H and W at least 2.
    scale : mm per px.

    Returns
    -------
    (H, W, 3) float32, x right, y down, z towards the object: (0, 0, 1) where the gel is at rest. They point
    to the middle of a ball that is pressed in.

    Examples
    --------
    >>> heights = np.tile(np.arange(4, dtype=np.float32) * 0.075, (3, 1))
    >>> normals = surface_normals(heights, Scale(0.1, 0.1, (0, 0), (0, 0)))
    >>> [round(part, 3) for part in normals[1, 1].tolist()]
    [0.6, 0.0, 0.8]
    """
    normals = np.empty((*heights.shape, 3), np.float32)
    for axis, step in ((0, scale.y), (1, scale.x)):
        normals[..., 1 - axis] = np.gradient(heights, np.float32(step), axis=axis)
    normals[..., 2] = 1
    normals /= np.sqrt(np.sum(normals * normals, axis=2, keepdims=True))
    return normals
