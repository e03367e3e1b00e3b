"""The largest change nearby, by which a change is measured, since light is never even."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from tactflow.vision.arrays import Floats32

OUTER: Final = 0.45
"""Fraction of the largest change nearby at which a change of slope is cut. Lower takes in more of the
surroundings of a contact and of gel that wrinkles; higher opens the ring where the light is faint. Chosen on
mini_ball, handmade_dots, gelslim_ball and the simulator: 0.4 to 0.5 overlap as well within 0.04."""

FAINT: Final = 0.3
"""Fraction of the largest change of the whole contact that the largest one nearby counts for at least.
Chosen by hand."""


def largest_nearby(values: Floats32, part: float = 1.0) -> Floats32:
    """(h, w): the largest value around, smoothed; no less than `FAINT` of the largest anywhere.

    "Around" reaches as far as the radius of a disc of as many pixels as have clearly changed, or a part of
    it: it holds a side of the contact, but not its other end.

    values : (h, w), >= 0.
    """
    high, wide = values.shape
    smooth = cv2.blur(values, (3, 3))
    peak = max(cv2.minMaxLoc(smooth)[1], 1e-9)
    count = np.count_nonzero(values > OUTER * peak)
    # At half the resolution, which is enough for what is smoothed.
    reach = round(part * math.sqrt(count / math.pi) / 2)
    side = 2 * reach + 1
    coarse = cv2.resize(smooth, (-(-wide // 2), -(-high // 2)), interpolation=cv2.INTER_AREA)
    # Beyond the window, nothing has changed.
    padded = np.pad(coarse, reach)
    around = cv2.blur(cv2.dilate(padded, np.ones((side, side), np.uint8)), (side, side))
    around = around[reach:, reach:][: coarse.shape[0], : coarse.shape[1]]
    nearby = cv2.resize(np.maximum(around, np.float32(FAINT * peak)), (wide, high))
    return np.asarray(nearby, np.float32)
