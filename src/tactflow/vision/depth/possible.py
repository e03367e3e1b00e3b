"""How deep a contact can be at all."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes
from tactflow.vision.types import Scale

DEPTH_BY_HALF_WIDTH: Final = 1.0
"""Greatest depth of a contact over half its width. A ball reaches 1 where it is pressed in as deep as its
equator; an edge, a cone or a pyramid reaches it with a right angle. 170 presses of balls on four gels have at
most 0.75. Only objects with steeper walls are deeper, whose slopes the camera hardly sees."""


def deepest_possible(mask: Bytes, scale: Scale, thickness: float | None = None) -> float:
    """Upper bound of the depth of a contact, mm.

    An object cannot be pressed in deeper than the gel is thick, and not much deeper than half the width of
    what touches (`DEPTH_BY_HALF_WIDTH`). The width is that of the narrowest rectangle around the contact,
    which is not known where the border of the picture cuts the contact off.

    Parameters
    ----------
    mask : (H, W) uint8, 255 in contact.
    scale : mm per px.
    thickness : of the gel, mm; None where it is not known.

    Returns
    -------
    Depth, mm; infinite where neither is known.

    Examples
    --------
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 20:60] = 255
    >>> scale = Scale(0.1, 0.1, (0, 0), (0, 0))
    >>> round(deepest_possible(mask, scale), 2), deepest_possible(mask, scale, 0.3)
    (0.5, 0.3)
    """
    most = math.inf if thickness is None else thickness
    border = mask[[0, -1]].any() or mask[:, [0, -1]].any()
    if border:
        return most
    # Half the resolution takes a third of the time.
    outlines, _ = cv2.findContours(mask[::2, ::2].copy(), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        return most
    outline = np.concatenate(outlines).reshape(-1, 2).astype(np.float32)
    outline *= np.array((2 * scale.x, 2 * scale.y), np.float32)
    # Outlines run through the middles of pixels.
    sides = np.add(cv2.minAreaRect(outline)[1], 2 * max(scale.x, scale.y))
    return min(most, DEPTH_BY_HALF_WIDTH * float(sides.min()) / 2)
