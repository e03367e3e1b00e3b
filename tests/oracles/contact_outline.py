"""Plain versions of the kernels that measure a contact's change, and seek the largest one nearby."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.contact_outline import GLOSS, cut_gloss
from tactflow.vision.contact.nearby import FAINT, OUTER, halve_smoothed, spread_largest
from tests.oracles.gains import Gain

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

SQUARE = np.ones((3, 3), np.uint8)


def plain_cut_gloss(
    strength: Float, brightness: Float, hidden: Mask, beside: Mask, cut: Float
) -> tuple[float, float, float]:
    """The mean of what is seen, weighted by itself, by OpenCV's norms."""
    beside[:] = cv2.dilate(hidden, SQUARE)
    seen = 1 - beside
    squares, total = cv2.norm(strength, cv2.NORM_L2SQR, seen), cv2.norm(strength, cv2.NORM_L1, seen)
    cap = GLOSS * max(squares / max(total, 1e-9), 1e-9)
    cut[:] = cv2.threshold(strength, cap, 0.0, cv2.THRESH_TRUNC)[1]
    return cap, cv2.norm(cut, cv2.NORM_L2SQR), cv2.norm(brightness, cv2.NORM_L2SQR)


def plain_halve_smoothed(values: Float, part: float, halved: Float) -> tuple[int, float]:
    """OpenCV's blur, and its resizing by areas."""
    smooth = np.asarray(cv2.blur(values, (3, 3)), np.float32)
    halved[:] = cv2.resize(smooth, halved.shape[::-1], interpolation=cv2.INTER_AREA)
    peak = max(float(smooth.max()), 1e-9)
    radius = math.sqrt(np.count_nonzero(values > np.float32(OUTER * peak)) / math.pi)
    return round(part * radius / 2), FAINT * peak


def plain_spread_largest(values: Float, reach: int, least: float, nearby: Float) -> None:
    """OpenCV's dilation, blur and bilinear resizing."""
    side = 2 * reach + 1
    largest = cv2.copyMakeBorder(values, *(reach,) * 4, cv2.BORDER_CONSTANT, value=(0.0,))
    largest = cv2.blur(cv2.dilate(largest, SQUARE, iterations=reach), (side, side))
    largest = np.maximum(largest[reach:, reach:][: len(values), : values.shape[1]], np.float32(least))
    nearby[:] = cv2.resize(largest, nearby.shape[::-1], interpolation=cv2.INTER_LINEAR)


GAINS = [
    # Sums of squares in another order, of a million and more: relative 1e-12.
    Gain(cut_gloss, plain_cut_gloss, tolerance=1e-6),
    # Of numbers of up to 50, in single precision.
    Gain(halve_smoothed, plain_halve_smoothed, tolerance=1e-5),
    Gain(spread_largest, plain_spread_largest, tolerance=1e-5),
]
