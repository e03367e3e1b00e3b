"""Plain version of the kernel of a contact's outline, and of what prepares a change for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.contact_outline import BIN, WindowChange, sum_profile
from tests.oracles.gains import Gain

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]


def change_of(picture: Float, inside: Mask) -> WindowChange:
    """A change of three channels, (h, w, 3) float32; only what is not 0 in `inside` counts."""
    counts = (inside > 0)[..., None] * picture
    strength = np.asarray(np.sqrt((counts * counts).sum(axis=2)), np.float32)
    brightness = np.asarray(counts.mean(axis=2), np.float32)
    return WindowChange(strength, brightness)


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


GAINS = [Gain(sum_profile, plain_sum_profile, tolerance=1e-9)]
