"""Plain version of halving a picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.downsample import halve_block
from tests.oracles.gains import Gain

Bytes = NDArray[np.uint8]


def plain_halve_block(
    picture: Bytes,
    top: int,
    left: int,
    half: Bytes,
    half_top: int,
    half_left: int,
    height: int,
    width: int,
    far: bool,  # noqa: ARG001
    upside_down: bool,
) -> None:
    """Block averages by OpenCV; rows hold three channels a pixel."""
    pixels, halves = picture.reshape(len(picture), -1, 3), half.reshape(len(half), -1, 3)
    block = pixels[top : top + 2 * height, left : left + 2 * width]
    halves[half_top : half_top + height, half_left : half_left + width] = plain_halved(block)[
        :: -1 if upside_down else 1
    ]


def plain_halved(picture: Bytes) -> Bytes:
    """Means over 2 x 2 px of (H, W, 3), an odd last row or column left out."""
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    even = picture[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


GAINS = [Gain(halve_block, plain_halve_block)]
