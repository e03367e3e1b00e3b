"""Normals of a surface from its heights."""

from __future__ import annotations

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes, Floats, Floats32
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
    replicate = cv2.BORDER_REPLICATE
    x, y = (
        np.asarray(cv2.Sobel(heights, cv2.CV_32F, *axes, ksize=1, scale=0.5 / step, borderType=replicate))
        for axes, step in (((1, 0), scale.x), ((0, 1), scale.y))
    )
    # At the border the difference is to the next pixel, not to the one after it.
    x[:, [0, -1]] *= 2
    y[[0, -1]] *= 2
    # Planes: with three numbers as the inner loop, NumPy takes six times as long.
    z = 1 / np.sqrt(x * x + y * y + 1)
    x *= z
    y *= z
    return np.asarray(cv2.merge([x, y, z]), np.float32)


def mean_normal(normals: Floats32, mask: Bytes) -> Floats | None:
    """Unit vector (3,) along the sum of the normals where a mask is not 0; None without one.

    normals : (H, W, 3) float32. mask : (H, W) uint8.

    >>> up = np.tile(np.float32([0, 0, 1]), (2, 3, 1))
    >>> mean_normal(up, np.ones((2, 3), np.uint8)).tolist()
    [0.0, 0.0, 1.0]
    """
    mean = np.array(cv2.mean(normals, mask)[:3])
    length = float(np.linalg.norm(mean))
    return mean / length if length else None
