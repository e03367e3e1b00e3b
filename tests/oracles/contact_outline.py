"""Plain versions of the kernels of a contact's outline, and of what prepares a change for it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.contact_outline import (
    BIN,
    BRIGHTENED_SCALE,
    HALF,
    RelativeChange,
    agree_with_region,
    sum_profile,
)
from tests.oracles.gains import Gain
from tests.oracles.typical import Arguments

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]


def change_of(picture: Float, inside: Mask) -> RelativeChange:
    """A relative change of three channels, (h, w, 3) float32; only what is not 0 in `inside` counts."""
    counts = (inside > 0)[..., None] * picture
    strength = np.asarray(np.sqrt((counts * counts).sum(axis=2)), np.float32)
    mean = np.asarray(counts.mean(axis=2), np.float32)
    return RelativeChange(
        strength, mean, float(mean.sum()), float(strength.sum()), float((strength**2).sum())
    )


def plain_agree_with_region(level: Float, filled: Mask) -> None:
    """The level where its sign agrees with the region, else the region's side."""
    sides = np.where(filled > 0, np.float32(HALF), np.float32(-HALF))
    agree = (level > 0) == (filled > 0)
    level[:] = np.where(agree, np.minimum(level, np.float32(HALF)), sides) * np.float32(BRIGHTENED_SCALE)


def plain_sum_profile(
    depth: Float,
    strength: Float,
    hidden: Mask,
    every: int,
    counts: NDArray[np.int64],
    sums: NDArray[np.float64],
) -> None:
    """Histograms of the depth, plain and weighted with the strength."""
    rows = slice(None, None, every)
    within = depth[rows] > 0
    if hidden.size:
        within &= hidden[rows] == 0
    bins = (depth[rows][within] * np.float32(1 / BIN)).astype(np.intp)
    counts += np.bincount(bins, minlength=len(counts))
    sums += np.bincount(bins, weights=strength[rows][within], minlength=len(sums))


def _brightened() -> Arguments:
    """A level set of the size of a contact, and a region that disagrees with it here and there."""
    rng = np.random.default_rng(0)
    level = rng.normal(0, 0.3, (90, 90)).astype(np.float32)
    return level, (cv2.blur(level, (3, 3)) > 0).view(np.uint8)


GAINS = [
    Gain(agree_with_region, plain_agree_with_region, arguments=_brightened),
    Gain(sum_profile, plain_sum_profile, tolerance=1e-9),
]
