"""Plain version of the kernel of a contact's outline, and of what prepares a change for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.contact_outline import (
    BIN,
    BORDER,
    DEEPEST,
    FALLEN,
    MIN_BIN_PIXELS,
    SHARP_SKIRT,
    SKIRT,
    SKIRT_BLUR,
    SOFTNESS,
    TOP,
    WindowChange,
    border_depth,
)
from tests.oracles.gains import Gain

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]


def change_of(picture: Float, inside: Mask) -> WindowChange:
    """A change of three channels, (h, w, 3) float32; only what is not 0 in `inside` counts."""
    counts = (inside > 0)[..., None] * picture
    strength = np.asarray(np.sqrt((counts * counts).sum(axis=2)), np.float32)
    brightness = np.asarray(counts.mean(axis=2), np.float32)
    return WindowChange(strength, brightness)


def plain_border_depth(
    depth: Float, strength: Float, hidden: Mask, every: int, middle: float, bins: NDArray[np.float64]
) -> float:
    """Histograms of the depth, plain and weighted with the strength; the rest step by step, as lists."""
    rows = slice(None, None, every)
    within = depth[rows] > 0
    if hidden.size:
        within &= hidden[rows] == 0
    places = (depth[rows][within] * np.float32(1 / BIN)).astype(np.intp)
    counts = np.bincount(places, minlength=bins.shape[1])
    total = np.bincount(places, weights=strength[rows][within], minlength=bins.shape[1])
    known = np.flatnonzero(counts >= MIN_BIN_PIXELS)
    if known.size < 2:
        return 0.5
    steps: list[float] = (total[known] / counts[known]).tolist()
    at: list[float] = ((known + 0.5) * BIN).tolist()
    around = zip([steps[0], *steps], steps, [*steps[1:], steps[-1]], strict=False)
    profile = [before / 4 + here / 2 + after / 4 for before, here, after in around]
    peak = _first_peak(profile)
    border, top, skirt = (_crossing(profile, at, part * peak) for part in (BORDER, TOP, SKIRT))
    soft = top - skirt - SHARP_SKIRT * (middle - top) - SKIRT_BLUR
    return min(border + SOFTNESS * max(soft, 0.0), DEEPEST * middle)


def _first_peak(profile: list[float]) -> float:
    """The largest value before the profile falls clearly for the first time."""
    peak = profile[0]
    for value in profile:
        if value > peak:
            peak = value
        elif value < FALLEN * peak:
            break
    return peak


def _crossing(profile: list[float], at: list[float], wanted: float) -> float:
    """Where, coming from outside, a profile first reaches a value."""
    first = next(index for index, value in enumerate(profile) if value >= wanted)
    if first == 0:
        return at[0]
    fraction = (wanted - profile[first - 1]) / (profile[first] - profile[first - 1])
    return at[first - 1] + fraction * (at[first] - at[first - 1])


GAINS = [Gain(border_depth, plain_border_depth, tolerance=1e-9, scratch=("bins",))]
