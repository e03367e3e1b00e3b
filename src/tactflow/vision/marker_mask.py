"""Where markers cover the gel: difference of Gaussians, two votes of three channels."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Polarity = Literal["dark", "bright"]


def marker_mask(
    image: NDArray[np.uint8], radius: float, *, polarity: Polarity = "dark", contrast: float = 6.0
) -> NDArray[np.uint8]:
    """Mask of round spots of a given size, without shift.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    radius : of a dot, processed pixels, > 0.
    polarity : whether the dots are darker or brighter than the gel.
    contrast : difference to the surroundings above which a channel votes, grey levels.

    Returns
    -------
    mask : (H, W) uint8, 255 on markers and their soft rim, else 0.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"required a non-empty (H, W, 3) uint8 image, got shape {image.shape}, dtype {image.dtype}"
        )
    wide = 2 * max(2, round(2 * radius)) + 1
    around = cv2.blur(image, (wide, wide))
    own = cv2.blur(image, (3, 3))
    response = cv2.subtract(around, own) if polarity == "dark" else cv2.subtract(own, around)
    first, second, third = cv2.split(response)
    median = cv2.max(cv2.min(first, second), cv2.min(cv2.max(first, second), third))
    _, mask = cv2.threshold(median, contrast, 255, cv2.THRESH_BINARY)
    return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8)), np.uint8)
