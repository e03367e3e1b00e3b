"""Compiled loops of `background`.

Pictures of several channels are passed as planes, (3, h, w), which vectorise, or interleaved, (h, 3 w).
Borders are reflected about the last pixel, OpenCV's default.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32
from tactflow.vision.compiled import helper, kernel
from tactflow.vision.contact.illumination import SATURATION_GREY

Byte = NDArray[np.uint8]

BLUR_SIGMA_PX: Final = 0.8
"""Standard deviation of the smoothing of changes, pixels of the window. Chosen by hand."""
_AT_ONE: Final = math.exp(-1 / (2 * BLUR_SIGMA_PX**2))
CENTER_WEIGHT: Final = np.float32(1 / (1 + 2 * _AT_ONE))
NEIGHBOUR_WEIGHT: Final = np.float32(_AT_ONE / (1 + 2 * _AT_ONE))
"""Weights of a pixel and of each of its two neighbours: a Gaussian with that standard deviation."""
BOX_WEIGHT: Final = np.float32(1 / 9)
"""Weight of one of 3 x 3 cells."""


@kernel("void(uint8[:, ::1], float32[:, :, ::1])")
def smooth_cells(half: Byte, smooth: Floats32) -> None:
    """Fill the planes `smooth`, (3, h, w), with means over 3 x 3 cells.

    half : (2 h, 6 w), a picture with cells of 2 x 2 pixels; their mean is rounded, as in `halved`.
    """
    _, high, wide = smooth.shape
    # Means of 2 x 2 pixels at each pixel of two lines; and a ring buffer of three lines of cells.
    means, cells = np.empty(6 * wide, np.uint8), np.empty((3, 3 * wide), np.uint8)
    sums, squares = np.empty(3 * wide + 6, np.int16), np.empty(3 * wide, np.int16)
    for row in range(high + 1):
        if row < high:
            upper, lower, line = half[2 * row], half[2 * row + 1], cells[row % 3]
            for i in range(6 * wide - 3):
                means[i] = (upper[i] + upper[i + 3] + lower[i] + lower[i + 3] + 2) >> 2
            for x in range(wide):
                for c in range(3):
                    line[3 * x + c] = means[6 * x + c]
        if row == 0:
            continue
        y = row - 1
        above = cells[(min(1, high - 1) if y == 0 else y - 1) % 3]
        here, below = cells[y % 3], cells[(max(high - 2, 0) if y == high - 1 else y + 1) % 3]
        for x in range(3 * wide):
            sums[x + 3] = np.int16(above[x]) + np.int16(here[x]) + np.int16(below[x])
        for c in range(3):
            sums[c] = sums[3 * min(2, wide) + c]
            sums[3 * wide + 3 + c] = sums[3 * max(wide - 1, 1) + c]
        for x in range(3 * wide):
            squares[x] = sums[x] + sums[x + 3] + sums[x + 6]
        for c in range(3):
            for x in range(wide):
                smooth[c, y, x] = np.float32(squares[3 * x + c]) * BOX_WEIGHT


@kernel(
    "UniTuple(float64, 4)(float32[:, :, ::1], float32[:, ::1], float32[::1], float32[::1],"
    " float32[:, :, ::1], float32[:, :, ::1], float32[:, ::1], float32[:, ::1], uint8[:, ::1],"
    " float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1])",
)
def weigh_change(
    smooth: Floats32,
    coefficients: Floats32,
    across: Floats32,
    down: Floats32,
    mean: Floats32,
    weight: Floats32,
    brightness: Floats32,
    colour_factor: Floats32,
    before: Byte,
    evidence_before: Floats32,
    squared: Floats32,
    colour: Floats32,
    evidence: Floats32,
) -> tuple[float, float, float, float]:
    """Squared deviations of each cell from the background under this frame's illumination.

    Returns the maxima of squared and of colour, and the sums of the evidence over `before` in this frame and
    in the previous one.

    smooth, mean, weight : (3, h, w). brightness, colour_factor : (h, w). coefficients : (3, 4). across,
    down : positions, (w,) and (h,). before : (h, w), cells in contact in the previous frame, and
    evidence_before : the evidence there; both (0, 0) if there were none. squared, colour, evidence : (h, w),
    filled.
    """
    high, wide = squared.shape
    along = np.empty(wide, np.float32)
    largest, largest_colour = np.empty(wide, np.float32), np.empty(wide, np.float32)
    largest[:] = largest_colour[:] = -np.inf
    now = was = 0.0
    for y in range(high):
        total, rest, both = squared[y], colour[y], evidence[y]
        for x in range(wide):
            total[x] = along[x] = 0
        for c in range(3):
            gain = coefficients[c, 0] + coefficients[c, 2] * down[y]
            slope, offset = coefficients[c, 1], coefficients[c, 3]
            line, usual = smooth[c, y], mean[c, y]
            scale = weight[c, y]
            for x in range(wide):
                light = usual[x] * (gain + slope * across[x]) + offset
                change, least = line[x] - usual[x] - light, line[x] - SATURATION_GREY
                change = change if change > least else least
                deviation = change * scale[x]
                total[x] = deviation * deviation + total[x]
                along[x] += deviation * scale[x] * usual[x]
        for x in range(wide):
            rest[x] = (total[x] - along[x] * along[x] * brightness[y, x]) * colour_factor[y, x]
            both[x] = total[x] if total[x] > rest[x] else rest[x]
            largest[x] = largest[x] if largest[x] > total[x] else total[x]
            largest_colour[x] = largest_colour[x] if largest_colour[x] > rest[x] else rest[x]
        if before.size:
            for x in range(wide):
                if before[y, x]:
                    now += both[x]
                    was += evidence_before[y, x]
    most = most_colour = np.float32(-np.inf)
    for x in range(wide):
        most, most_colour = max(most, largest[x]), max(most_colour, largest_colour[x])
    return float(most), float(most_colour), now, was


@kernel(
    "void(Array(uint8, 2, 'C', readonly=True), int64, int64, float32[:, ::1], float32[::1], float32[::1],"
    " float32[:, ::1], float32[:, ::1], float32[:, ::1])",
)
def scaled_change(
    picture: Byte,
    top: int,
    left: int,
    coefficients: Floats32,
    across: Floats32,
    down: Floats32,
    mean: Floats32,
    scale: Floats32,
    change: Floats32,
) -> None:
    """Signed change in a window, in standard deviations, smoothed along x.

    picture : (H, 3 W), the frame at the window's resolution. top, left : of the window. coefficients :
    (3, 4), of `IlluminationModel.fit`. across, down : positions, (W,) and (H,). mean, scale : (H, 3 W).
    change : (h, 3 w), filled.
    """
    high, wide = change.shape
    light = _light_along(coefficients, across[left : left + wide // 3])
    first, last = 3 * left, 3 * left + wide
    # One more pixel on either side.
    line = np.empty(wide + 6, np.float32)
    for y in range(high):
        row = top + y
        values, usual, unit = picture[row, first:last], mean[row, first:last], scale[row, first:last]
        _scale_line(values, usual, unit, light, down[row], line[3:])
        for c in range(3):
            line[c], line[wide + 3 + c] = line[3 * min(2, wide // 3) + c], line[max(wide - 3, 3) + c]
        smooth = change[y]
        for i in range(wide):
            smooth[i] = (line[i] + line[i + 6]) * NEIGHBOUR_WEIGHT + line[i + 3] * CENTER_WEIGHT


@helper
def _light_along(coefficients: Floats32, places: Floats32) -> Floats32:
    """(3, 3 w) float32: gain in the middle row of the frame, its slope along y, and offset, interleaved."""
    light = np.empty((3, 3 * places.size), np.float32)
    for x in range(places.size):
        for c in range(3):
            light[0, 3 * x + c] = coefficients[c, 0] + coefficients[c, 1] * places[x]
            light[1, 3 * x + c], light[2, 3 * x + c] = coefficients[c, 2], coefficients[c, 3]
    return light


@helper
def _scale_line(
    values: Byte,
    mean: Floats32,
    scale: Floats32,
    light: Floats32,
    place: np.float32,
    changes: Floats32,
) -> None:
    """Fill `changes` with the change of a line, standard deviations; light : from `_light_along`."""
    gain, slope, offset = light
    for i in range(values.size):
        value, usual = np.float32(values[i]), mean[i]
        change = value - usual - (usual * (gain[i] + slope[i] * place) + offset[i])
        least = value - SATURATION_GREY
        changes[i] = (change if change > least else least) * scale[i]
