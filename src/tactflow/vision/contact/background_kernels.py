"""Compiled loops of `background`.

Pictures of several channels come as planes, (3, h, w), which vectorise; interleaved ones as (h, 3 w).
Neighbours beyond the border are those mirrored about the last pixel, as OpenCV takes them by default.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32, Indices
from tactflow.vision.compiled import helper, kernel
from tactflow.vision.contact.illumination import WHITE

Byte = NDArray[np.uint8]

BLUR_SIGMA: Final = 0.8
"""Standard deviation by which changes are smoothed, pixels of the window. Chosen by hand."""
_AT_ONE: Final = math.exp(-1 / (2 * BLUR_SIGMA**2))
MIDDLE: Final = np.float32(1 / (1 + 2 * _AT_ONE))
BESIDE: Final = np.float32(_AT_ONE / (1 + 2 * _AT_ONE))
"""Weights of a pixel and of each of its two neighbours, those of a Gaussian with that standard deviation."""
NINTH: Final = np.float32(1 / 9)
"""Weight of one of 3 x 3 cells."""


@kernel("void(uint8[:, ::1], float32[:, :, ::1])")
def smooth_cells(half: Byte, smooth: Floats32) -> None:
    """Means over 3 x 3 cells into the planes `smooth`, (3, h, w).

    half : (2 h, 6 w), a picture of which 2 x 2 pixels are a cell; their mean is rounded, as `halved` does.
    """
    _, high, wide = smooth.shape
    # Of each pixel and the next one, of two lines; lines of cells, of which three are in use.
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
                smooth[c, y, x] = np.float32(squares[3 * x + c]) * NINTH


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

    Returns the largest of squared and of colour, and the sums of the evidence over `before`, now and then.

    smooth, mean, weight : (3, h, w). brightness, colour_factor : (h, w). coefficients : (3, 4). across,
    down : positions, (w,) and (h,). before : (h, w), cells in contact in the previous frame, and
    evidence_before : the evidence there; both (0, 0) if none. squared, colour, evidence : (h, w), filled.
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
                change, least = line[x] - usual[x] - light, line[x] - WHITE
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
    " float32[:, ::1],"
    " float32[:, ::1], float32[:, ::1], uint8[:, ::1], float32[:, ::1], int64[:, ::1], float32[::1])",
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
    pattern: Floats32,
    inside: Byte,
    blurred: Floats32,
    spans: Indices,
    peaks: Floats32,
) -> None:
    """How a window has changed where it counts, in standard deviations, smoothed along x.

    picture : (H, 3 W), the frame at the window's resolution. top, left : of the window. coefficients, across,
    down : as for `weigh_change`, at this resolution. mean, scale : (H, 3 W). pattern : (H, 3 W), direction
    p in which the channels change where the gel's pattern moves: of a change v, (p . v) p is left out.
    inside : (r, s), not 0 where a block of the window counts. blurred : (h, 3 w), filled in each row of
    blocks where it, the one above or the one below count, and between; elsewhere left as it is. spans :
    (r, 2), filled for each row of blocks with the first pixel that counts and that after the last. peaks :
    (5,), filled with the largest changes of a channel in there: of the first row, of the last, of the first
    column, of the last, of all.
    """
    high, wide = len(blurred), blurred.shape[1] // 3
    side = high // len(inside)
    _find_spans(inside, side, spans)
    light = _light_along(coefficients, across[left : left + wide])
    # With a pixel more on both sides.
    line, most = np.empty(3 * wide + 6, np.float32), np.empty(3 * wide, np.float32)
    begin, end = 0, 0
    most[:] = peaks[:] = 0
    for y in range(high):
        if y % side == 0:
            begin, end = _neighbours(spans, y // side, wide)
        if begin >= end:
            continue
        first, last, count = max(begin - 1, 0), min(end + 1, wide), 3 * (end - begin)
        row, start, shift = top + y, 3 * (left + first), 3 * (first - begin + 1)
        values, usual = picture[row, start : 3 * (left + last)], mean[row, start:]
        unit, toward = scale[row, start:], pattern[row, start:]
        _scale_line(values, usual, unit, toward, light, first, down[row], line[shift:])
        for c in range(3):
            if begin == 0:
                line[c] = line[3 * min(2, wide) + c]
            if end == wide:
                line[count + 3 + c] = line[max(count - 3, 3) + c]
        smooth, largest = blurred[y, 3 * begin :], most[3 * begin :]
        for i in range(count):
            smooth[i] = (line[i] + line[i + 6]) * BESIDE + line[i + 3] * MIDDLE
            size = abs(smooth[i])
            largest[i] = largest[i] if largest[i] > size else size
        if y == 0:
            for i in range(count):
                peaks[0] = max(peaks[0], largest[i])
    for i in range(3 * begin, 3 * end):
        peaks[1] = max(peaks[1], abs(blurred[high - 1, i]))
    _note_peaks(most, peaks)


@helper
def _note_peaks(most: Floats32, peaks: Floats32) -> None:
    """The first and the last column's peaks and that of all, of the largest change in each column, (3 w,)."""
    for c in range(3):
        peaks[2], peaks[3] = max(peaks[2], most[c]), max(peaks[3], most[most.size - 3 + c])
    for i in range(most.size):
        peaks[4] = max(peaks[4], most[i])


@helper
def _find_spans(inside: Byte, side: int, spans: Indices) -> None:
    """Fill `spans` as `scaled_change` does; both 0 where nothing in a row of blocks counts."""
    for row in range(len(inside)):
        first, end = 0, inside.shape[1]
        while end > 0 and not inside[row, end - 1]:
            end -= 1
        while first < end and not inside[row, first]:
            first += 1
        spans[row, 0], spans[row, 1] = side * first, side * end


@helper
def _light_along(coefficients: Floats32, places: Floats32) -> Floats32:
    """(3, 3 w) float32: gain in the frame's middle row, its slope along y, offset; of each channel."""
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
    pattern: Floats32,
    light: Floats32,
    first: int,
    place: np.float32,
    changes: Floats32,
) -> None:
    """Fill `changes` with the change of a line from pixel `first` of the window on, standard deviations."""
    gain, slope, offset = light[0, 3 * first :], light[1, 3 * first :], light[2, 3 * first :]
    for i in range(values.size):
        value, usual = np.float32(values[i]), mean[i]
        change = value - usual - (usual * (gain[i] + slope[i] * place) + offset[i])
        least = value - WHITE
        changes[i] = (change if change > least else least) * scale[i]
    for x in range(values.size // 3):
        blue, green, red = changes[3 * x], changes[3 * x + 1], changes[3 * x + 2]
        along = blue * pattern[3 * x] + green * pattern[3 * x + 1] + red * pattern[3 * x + 2]
        changes[3 * x] = blue - along * pattern[3 * x]
        changes[3 * x + 1] = green - along * pattern[3 * x + 1]
        changes[3 * x + 2] = red - along * pattern[3 * x + 2]


@helper
def _neighbours(spans: Indices, row: int, wide: int) -> tuple[int, int]:
    """The first pixel in the spans of a row and of those above and below, and that after the last."""
    begin, end = wide, 0
    for near in range(max(row - 1, 0), min(row + 2, len(spans))):
        if spans[near, 1]:
            begin, end = min(begin, spans[near, 0]), max(end, spans[near, 1])
    return begin, end


@kernel(
    "void(float32[:, ::1], uint8[:, ::1], int64[:, ::1], float32, float32[::1], float32[:, ::1],"
    " float32[:, ::1])",
)
def change_strength(
    blurred: Floats32,
    inside: Byte,
    spans: Indices,
    gain: np.float32,
    strongest: Floats32,
    strength: Floats32,
    common: Floats32,
) -> None:
    """Smooth a change along y, and reduce its channels to one.

    blurred, inside, spans : from `scaled_change`. gain, strongest : a `Response`. strength : (h, w), filled
    with the length of the change over the channels, so weighed. common : (h, w), filled with their mean. Both
    0 where nothing counts.
    """
    high, wide = strength.shape
    side = high // len(inside)
    smooth = np.empty(3 * wide, np.float32)
    for y in range(high):
        row = y // side
        first, count = spans[row, 0], spans[row, 1] - spans[row, 0]
        above = min(1, high - 1) if y == 0 else y - 1
        below = max(high - 2, 0) if y == high - 1 else y + 1
        upper, here, lower = blurred[above, 3 * first :], blurred[y, 3 * first :], blurred[below, 3 * first :]
        for i in range(3 * count):
            smooth[i] = (upper[i] + lower[i]) * BESIDE + here[i] * MIDDLE
        strength[y], common[y] = 0, 0
        length, tone = strength[y, first:], common[y, first:]
        for x in range(count):
            blue, green, red = smooth[3 * x], smooth[3 * x + 1], smooth[3 * x + 2]
            along = blue * strongest[0] + green * strongest[1] + red * strongest[2]
            square = gain * (blue * blue + green * green + red * red) - along * along
            length[x] = np.sqrt(square if square > 0 else np.float32(0))
            tone[x] = (blue + green + red) * np.float32(1 / 3)
        cells = inside[row, first // side :]
        for cell in range(count // side):
            if not cells[cell]:
                length[side * cell : side * cell + side] = 0
                tone[side * cell : side * cell + side] = 0
