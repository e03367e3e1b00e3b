"""Plain versions of the kernels between a frame's resolution and half of it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.resolution import halve_window, raise_mask
from tests.oracles.gains import Gain

Mask = NDArray[np.uint8]


def plain_raise_mask(level: NDArray[np.float32], top: int, left: int, mask: Mask) -> bool:
    """255 where the level, enlarged by OpenCV, is positive; whether it is anywhere."""
    window = mask[top : top + 2 * level.shape[0], left : left + 2 * level.shape[1]]
    large = cv2.resize(level, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    large = large.reshape(2 * level.shape[0], 2 * level.shape[1])
    positive = large[: window.shape[0], : window.shape[1]] > 0
    window[positive] = 255
    return bool(positive.any())


def plain_halve_window(mask: Mask, top: int, left: int, inside: Mask, halved: Mask) -> None:
    """Blocks of 2 x 2 px of the window in which any pixel is not 0, in cells that are inside."""
    part = mask[top : top + 2 * halved.shape[0], left : left + 2 * halved.shape[1]]
    whole = np.zeros((2 * halved.shape[0], 2 * halved.shape[1]), np.bool_)
    whole[: part.shape[0], : part.shape[1]] = part > 0
    blocks = whole.reshape(halved.shape[0], 2, halved.shape[1], 2).any(axis=(1, 3))
    halved[:] = blocks & (inside > 0).repeat(2, axis=0).repeat(2, axis=1)


GAINS = [
    # A pixel whose level is zero to rounding may go either way.
    Gain(raise_mask, plain_raise_mask, outliers=1e-4),
    Gain(halve_window, plain_halve_window),
]
