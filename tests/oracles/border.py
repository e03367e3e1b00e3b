"""Plain version of the kernel that finds how deep inside a change a contact ends; changes to try it on."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.border import (
    BIN,
    BORDER,
    DEEPEST,
    FALLEN,
    FEWEST_ARCS,
    LEANS,
    MIN_ARC_PIXELS,
    MIN_BIN_PIXELS,
    SHARP_SKIRT,
    SKIRT,
    SKIRT_BLUR,
    SOFTNESS,
    STEPS,
    TOP,
    VARIES,
)
from tactflow.vision.contact.contact_outline import WindowChange

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]


def change_of(picture: Float, inside: Mask) -> WindowChange:
    """A change of three channels, (h, w, 3) float32; only what is not 0 in `inside` counts."""
    counts = (inside > 0)[..., None] * picture
    strength = np.asarray(np.sqrt((counts * counts).sum(axis=2)), np.float32)
    brightness = np.asarray(counts.mean(axis=2), np.float32)
    return WindowChange(strength, brightness)


def plain_border_level(
    parts: Float,
    nearest: NDArray[np.int32],
    corners: NDArray[np.int32],
    outlines: NDArray[np.int32],
    strength: Float,
    hidden: Mask,
    middle: float,
    level: Float,
) -> None:
    """Histograms of the depth over all pixels at once, smoothed along each outline by a convolution."""
    marks = np.zeros(parts.shape, np.float32)
    for (begin, first, _), (end, last, length) in pairwise(outlines.tolist()):
        x, y = _passed(corners[begin:end]).T
        marks[y, x] = 1 + first + np.arange(length) * ((last - first) / length)
    marks = np.asarray(cv2.dilate(marks, np.ones((3, 3), np.uint8)), np.float32)
    place = np.zeros(parts.size + 1, np.float32)
    beside = (parts <= 0) & (marks > 0)
    place[nearest[beside]] = marks[beside]
    step = place[nearest].astype(np.intp) - 1
    seen = (parts > 0) & (hidden == 0)
    at = (parts * np.float32(1 / BIN)).astype(np.intp)
    bins = np.zeros((outlines[-1, 1] + 1, 2, int(middle / BIN) + 2))
    for row, counted in ((step, seen & (step >= 0)), (np.full_like(step, len(bins) - 1), seen)):
        np.add.at(bins[:, 0], (row[counted], at[counted]), 1)
        np.add.at(bins[:, 1], (row[counted], at[counted]), strength[counted])
    whole = _border_depth(bins[-1], MIN_BIN_PIXELS, middle, 0.5)
    offsets = np.arange(1 - STEPS, STEPS)
    borders, weights = [], []
    for first, last in pairwise(outlines[:, 1].tolist()):
        varies = VARIES * min((last - first) / (STEPS * FEWEST_ARCS), LEANS)
        own = bins[first:last]
        for k in range(last - first):
            around = own[(k + offsets) % len(own)]
            profile = ((1 - np.abs(offsets) / STEPS)[:, None, None] * around).sum(axis=0)
            found = _border_depth(profile, MIN_ARC_PIXELS, middle, whole)
            borders.append(min(max(found, (1 - varies) * whole), (1 + varies) * whole))
            weights.append(profile[0].sum())
    border, weight = np.array(borders), np.array(weights)
    border += whole - (weight * border).sum() / max(weight.sum(), 1e-9)
    inside = (parts > 0) & (step >= 0)
    depth = np.full(parts.shape, whole)
    depth[inside] = np.maximum(border[step[inside]], BIN)
    level[:] = parts - depth.astype(np.float32)


def _passed(corners: NDArray[np.int32]) -> NDArray[np.int32]:
    """Pixels that a closed outline passes, (n, 2), of those where it turns."""
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.concatenate(
        [
            np.linspace(start, end, max(int(np.abs(end - start).max()), 1), endpoint=False).astype(np.int32)
            for start, end in sides
        ]
    )


def _border_depth(bins: NDArray[np.float64], least: int, middle: float, otherwise: float) -> float:
    """How deep the border lies by one profile, (2, n)."""
    known = np.flatnonzero(bins[0] >= least)
    if known.size < 2:
        return otherwise
    steps: list[float] = (bins[1, known] / bins[0, known]).tolist()
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
