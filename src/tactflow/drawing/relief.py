"""A height map as a picture: coloured by height, shaded as a matt surface under a lamp."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.types import Scale

LAMP_DIRECTION: Final = np.array([-0.45, -0.55, 0.7], np.float32) / np.float32(
    np.hypot(np.hypot(0.45, 0.55), 0.7)
)
"""Direction towards the lamp: x right, y down, z towards the viewer. Upper left, as on maps. The lamp, the
share below and the height are those of the live page, chosen by hand, by how pictures look."""
AMBIENT_SHARE: Final = 0.35
"""Share of the light that comes from everywhere."""
HEIGHT_GAIN: Final = 3.0
"""How much higher than it is the surface is shaded: contacts are flat."""


def relief(heights: NDArray[np.float32], scale: Scale, deepest: float) -> NDArray[np.uint8]:
    """A height map as seen from the camera: what is pushed in rises towards the viewer.

    heights : (H, W) float32, mm >= 0. scale : mm per px. deepest : height of the lightest colour, mm > 0.
    Returns (H, W, 3) uint8, BGR: from violet at 0 over green to yellow (viridis).

    >>> heights = np.zeros((40, 60), np.float32)
    >>> heights[10:30, 20:40] = 1
    >>> picture = relief(heights, Scale(0.1, 0.1, (0, 0), (0, 0)), 1.0)
    >>> picture[0, 0].tolist(), picture[20, 30].tolist()
    ([84, 1, 68], [37, 231, 253])
    """
    levels = np.rint(np.minimum(heights * np.float32(255 / deepest), 255)).astype(np.uint8)
    picture = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), np.uint8)
    x, y, width, height = cv2.boundingRect(levels)
    if not width:
        return picture
    # Around the part that is not 0, there is nothing to shade.
    part = (slice(max(0, y - 1), y + height + 1), slice(max(0, x - 1), x + width + 1))
    down, across = np.gradient(np.pad(heights[part], 1) * np.float32(HEIGHT_GAIN))
    down, across = down[1:-1, 1:-1] / scale.y, across[1:-1, 1:-1] / scale.x
    lit = (LAMP_DIRECTION[2] - across * LAMP_DIRECTION[0] - down * LAMP_DIRECTION[1]) / np.sqrt(
        across * across + down * down + 1
    )
    light = AMBIENT_SHARE + (1 - AMBIENT_SHARE) * np.maximum(lit, 0) / LAMP_DIRECTION[2]
    picture[part] = np.minimum(picture[part] * light[..., None], 255).astype(np.uint8)
    return picture


def normals_picture(normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, BGR: unit normals (H, W, 3) as a normal map, x as red, y upwards as green, z as blue.

    >>> normals_picture(np.array([[[0, 0, 1], [1, 0, 0]]], np.float32)).tolist()
    [[[255, 128, 128], [128, 128, 255]]]
    """
    upwards = normals[..., ::-1] * np.array([1, -1, 1], np.float32)
    return np.asarray(np.rint(127.5 + 127.5 * upwards), np.uint8)


def colour_bar(width: int, height: int) -> NDArray[np.uint8]:
    """(height, width, 3) uint8: the colours of `relief`, from 0 on the left to the deepest on the right.

    >>> colour_bar(256, 2)[0, [0, 255]].tolist()
    [[84, 1, 68], [37, 231, 253]]
    """
    levels = np.tile(np.linspace(0, 255, width).astype(np.uint8), (height, 1))
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), np.uint8)
