"""Compiled loops of `background`.

Pictures of several channels come as planes, (3, h, w), which vectorise; interleaved ones as (h, 3 w).
Neighbours beyond the border are those mirrored about the last pixel, as OpenCV takes them by default.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel
from tactflow.vision.contact.illumination import WHITE

Float = NDArray[np.float32]
Double = NDArray[np.float64]
Byte = NDArray[np.uint8]

BLUR_SIGMA: Final = 0.8
"""Standard deviation by which changes are smoothed, pixels at half resolution. Chosen by hand."""
_AT_ONE: Final = math.exp(-1 / (2 * BLUR_SIGMA**2))
MIDDLE: Final = np.float32(1 / (1 + 2 * _AT_ONE))
BESIDE: Final = np.float32(_AT_ONE / (1 + 2 * _AT_ONE))
"""Weights of a pixel and of each of its two neighbours, those of a Gaussian with that standard deviation."""
NINTH: Final = np.float32(1 / 9)
"""Weight of one of 3 x 3 cells."""


@kernel("void(uint8[:, ::1], float32[:, :, ::1])")
def smooth_cells(cells: Byte, smooth: Float) -> None:
    """Means over 3 x 3 cells, (h, 3 w), into the planes `smooth`, (3, h, w)."""
    high, wide = smooth.shape[1:]
    sums, squares = np.empty(3 * wide + 6, np.int16), np.empty(3 * wide, np.int16)
    for y in range(high):
        above = cells[min(1, high - 1) if y == 0 else y - 1]
        here, below = cells[y], cells[max(high - 2, 0) if y == high - 1 else y + 1]
        for x in range(3 * wide):
            sums[x + 3] = np.int16(above[x]) + np.int16(here[x]) + np.int16(below[x])
        for c in range(3):
            sums[c] = sums[3 * min(2, wide) + c]
            sums[3 * wide + 3 + c] = sums[3 * max(wide - 1, 1) + c]
        for x in range(3 * wide):
            squares[x] = sums[x] + sums[x + 3] + sums[x + 6]
        for c in range(3):
            for x in range(wide):
                smooth[c, y, x] = np.float32(squares[3 * x + c]) * NINTH


@kernel(
    "void(float32[:, :, ::1], float32[:, ::1], float32[::1], float32[::1], float32[:, :, ::1],"
    " float32[:, :, ::1], float32[:, :, ::1], float32[:, ::1], uint8[:, ::1],"
    " float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1], float64[::1])",
    reorder=True,
)
def weigh_change(
    smooth: Float,
    coefficients: Float,
    across: Float,
    down: Float,
    mean: Float,
    weight: Float,
    brightness: Float,
    colour_factor: Float,
    before: Byte,
    evidence_before: Float,
    squared: Float,
    colour: Float,
    evidence: Float,
    summary: Double,
) -> None:
    """Squared deviations of each cell from the background under this frame's illumination.

    smooth, mean, weight, brightness : (3, h, w). coefficients : (3, 4). across, down : positions,
    (w,) and (h,). before : (h, w), cells in contact in the previous frame, and evidence_before : the evidence
    there; both (0, 0) if none. squared, colour, evidence : (h, w), filled. summary : filled with the largest
    of squared and of colour, and the sums of the evidence over `before`, now and then.
    """
    high, wide = squared.shape
    largest = np.full(wide, -np.inf, np.float32)
    largest_colour = np.full(wide, -np.inf, np.float32)
    along = np.empty(wide, np.float32)
    now = was = 0.0
    for y in range(high):
        total, rest, both = squared[y], colour[y], evidence[y]
        for c in range(3):
            gain = coefficients[c, 0] + coefficients[c, 2] * down[y]
            slope, offset = coefficients[c, 1], coefficients[c, 3]
            line, usual = smooth[c, y], mean[c, y]
            scale, tone = weight[c, y], brightness[c, y]
            for x in range(wide):
                light = usual[x] * (gain + slope * across[x]) + offset
                change, least = line[x] - usual[x] - light, line[x] - WHITE
                change = change if change > least else least
                deviation = change * scale[x]
                total[x] = deviation * deviation + (total[x] if c else np.float32(0))
                along[x] = change * tone[x] + (along[x] if c else np.float32(0))
        for x in range(wide):
            rest[x] = total[x] * colour_factor[y, x] - along[x] * along[x]
            both[x] = total[x] if total[x] > rest[x] else rest[x]
            largest[x] = largest[x] if largest[x] > total[x] else total[x]
            largest_colour[x] = largest_colour[x] if largest_colour[x] > rest[x] else rest[x]
        if before.size:
            for x in range(wide):
                inside = np.float32(before[y, x])
                now += inside * both[x]
                was += inside * evidence_before[y, x]
    summary[0] = summary[1] = -np.inf
    for x in range(wide):
        summary[0] = max(summary[0], largest[x])
        summary[1] = max(summary[1], largest_colour[x])
    summary[2], summary[3] = now, was


@kernel(
    "void(uint8[:, ::1], int64, int64, float32[:, ::1], float32[::1], float32[::1], float32[:, :, ::1],"
    " float32[:, :, ::1], float32[:, :, ::1], float32[:, :, ::1])",
    reorder=True,
)
def scaled_change(
    half: Byte,
    top: int,
    left: int,
    coefficients: Float,
    across: Float,
    down: Float,
    mean: Float,
    scale: Float,
    pattern: Float,
    blurred: Float,
) -> None:
    """How a window has changed at half resolution, in standard deviations, smoothed along x.

    half : (H, 3 W), the frame. top, left : of the window. coefficients, across, down : as for
    `weigh_change`, at this resolution. mean, scale : (3, H, W). pattern : (3, H, W), direction p in which the
    channels change where the gel's pattern moves: of a change v, (p . v) p is left out.
    blurred : (3, h, w), filled.
    """
    high, wide = blurred.shape[1:]
    lines, place = np.empty((3, wide), np.float32), across[left:]
    along = np.empty(wide, np.float32)
    second, last = min(1, wide - 1), wide - 1
    for y in range(high):
        picture = half[top + y, 3 * left :]
        for c in range(3):
            gain = coefficients[c, 0] + coefficients[c, 2] * down[top + y]
            slope, offset = coefficients[c, 1], coefficients[c, 3]
            usual, unit = mean[c, top + y, left:], scale[c, top + y, left:]
            line, toward = lines[c], pattern[c, top + y, left:]
            for x in range(wide):
                light = usual[x] * (gain + slope * place[x]) + offset
                value = np.float32(picture[3 * x + c])
                change, least = value - usual[x] - light, value - WHITE
                change = change if change > least else least
                line[x] = change * unit[x]
                along[x] = line[x] * toward[x] + (along[x] if c else np.float32(0))
        for c in range(3):
            line, row, toward = lines[c], blurred[c, y], pattern[c, top + y, left:]
            for x in range(wide):
                line[x] -= along[x] * toward[x]
            for x in range(1, wide - 1):
                row[x] = (line[x - 1] + line[x + 1]) * BESIDE + line[x] * MIDDLE
            row[0] = (line[second] + line[second]) * BESIDE + line[0] * MIDDLE
            before = line[max(last - 1, 0)]
            row[last] = (before + before) * BESIDE + line[last] * MIDDLE


@kernel(
    "void(float32[:, :, ::1], uint8[:, ::1], float32, float32[::1], float32[:, ::1], float32[:, ::1])",
    reorder=True,
)
def change_strength(
    blurred: Float, inside: Byte, gain: np.float32, strongest: Float, strength: Float, common: Float
) -> None:
    """Smooth a change along y, and reduce its channels to one.

    blurred : (3, h, w), from `scaled_change`. inside : (h / 2, w / 2), cells that count. gain, strongest : a
    `Response`. strength : (h, w), filled with the length of the change over the channels, so weighed.
    common : (h, w), filled with their mean.
    """
    high, wide = strength.shape
    counts, third = np.empty(wide, np.float32), np.float32(1 / 3)
    along = np.empty(wide, np.float32)
    for y in range(high):
        above = min(1, high - 1) if y == 0 else y - 1
        below = max(high - 2, 0) if y == high - 1 else y + 1
        for x in range(wide // 2):
            counts[2 * x] = counts[2 * x + 1] = np.float32(inside[y // 2, x] != 0)
        length, tone = strength[y], common[y]
        for c in range(3):
            upper, here, lower = blurred[c, above], blurred[c, y], blurred[c, below]
            for x in range(wide):
                value = ((upper[x] + lower[x]) * BESIDE + here[x] * MIDDLE) * counts[x]
                length[x] = value * value + (length[x] if c else np.float32(0))
                along[x] = value * strongest[c] + (along[x] if c else np.float32(0))
                tone[x] = value + (tone[x] if c else np.float32(0))
        for x in range(wide):
            square = gain * length[x] - along[x] * along[x]
            length[x] = np.sqrt(square if square > 0 else np.float32(0))
            tone[x] *= third
