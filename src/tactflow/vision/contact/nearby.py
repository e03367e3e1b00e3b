"""The largest change nearby, by which a change is measured, since light is never even."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from tactflow.vision.arrays import Floats32
from tactflow.vision.compiled import kernel

OUTER: Final = 0.55
"""Fraction of the largest change nearby at which a change of slope is cut. Lower takes in more of the
surroundings of a contact and of gel that wrinkles; higher opens the ring where the light is faint. On
outlines of fifteen labs 0.5 to 0.6 overlap as well within 0.02 (`tactflow.bench.judge`)."""

FAINT: Final = 0.3
"""Fraction of the largest change of the whole contact that the largest one nearby counts for at least.
Chosen by hand."""


def largest_nearby(values: Floats32) -> Floats32:
    """(h, w): the largest value around, smoothed; no less than `FAINT` of the largest anywhere.

    "Around" reaches as far as the radius of a disc of as many pixels as have clearly changed: it holds a side
    of the contact, but not its other end.
    """
    high, wide = values.shape
    rows, columns = -(-high // 2), -(-wide // 2)
    coarse, nearby = np.empty((rows, columns), np.float32), np.empty((2 * rows, 2 * columns), np.float32)
    reach, least = halve_smoothed(values, coarse)
    spread_largest(coarse, reach, least, nearby)
    return nearby[:high, :wide]


@kernel("Tuple((int64, float64))(float32[:, ::1], float32[:, ::1])")
def halve_smoothed(values: Floats32, halved: Floats32) -> tuple[int, float]:
    """Means over 3 x 3 pixels, and over 2 x 2 of them.

    Returns how far "around" reaches, two pixels, and the least that counts.

    values : (h, w). halved : (h / 2, w / 2), rounded up, filled; the last line counts
    twice then.
    """
    (high, wide), (rows, columns) = values.shape, halved.shape
    sums, line = np.empty(wide + 2), np.empty(wide + 1, np.float32)
    upper, largest = np.empty(wide + 1, np.float32), np.empty(wide, np.float32)
    largest[:] = 0
    for y in range(2 * rows):
        row = min(y, high - 1)
        above = values[min(1, high - 1) if row == 0 else row - 1]
        here, below = values[row], values[max(high - 2, 0) if row == high - 1 else row + 1]
        for x in range(wide):
            sums[x + 1] = np.float64(above[x]) + here[x] + below[x]
        # Beyond the border are those mirrored about the last pixel.
        sums[0], sums[wide + 1] = sums[min(2, wide)], sums[max(wide - 1, 1)]
        for x in range(wide):
            line[x] = (sums[x] + sums[x + 1] + sums[x + 2]) * (1 / 9)
            largest[x] = line[x] if line[x] > largest[x] else largest[x]
        line[wide] = line[wide - 1]
        if y & 1:
            for x in range(columns):
                both = upper[2 * x] + upper[2 * x + 1] + (line[2 * x] + line[2 * x + 1])
                halved[y >> 1, x] = both * np.float32(0.25)
        upper, line = line, upper
    peak, count = 1e-9, 0
    for x in range(wide):
        peak = max(peak, largest[x])
    limit = np.float32(OUTER * peak)
    for y in range(high):
        for x in range(wide):
            count += values[y, x] > limit
    return round(math.sqrt(count / math.pi) / 2), FAINT * peak


@kernel("void(float32[:, ::1], int64, float64, float32[:, ::1])")
def spread_largest(values: Floats32, reach: int, least: float, nearby: Floats32) -> None:
    """The mean, over a square, of the largest values in as large ones, interpolated to twice the resolution.

    values : (h, w). reach : half the side of a square. least : of what is interpolated, at least.
    nearby : (2 h, 2 w), filled.
    """
    high, wide = values.shape
    side, broad = 2 * reach + 1, wide + 2 * reach
    # The largest of so many next to one another, of twice as many, and so on; along x, then along y.
    around = np.empty((high + 4 * reach + 1, broad), np.float32)
    line, wider = np.empty(broad + 2 * reach, np.float32), np.empty(broad + 2 * reach, np.float32)
    around[:] = 0
    for y in range(high):
        line[:] = 0
        for x in range(wide):
            line[x + 2 * reach] = values[y, x]
        span = 1
        while 2 * span <= side:
            ahead = line[span:]
            for x in range(ahead.size):
                wider[x] = line[x] if line[x] > ahead[x] else ahead[x]
            line, wider, span = wider, line, 2 * span
        ahead, row = line[side - span :], around[y + 2 * reach]
        for x in range(broad):
            row[x] = line[x] if line[x] > ahead[x] else ahead[x]
    span = 1
    while span < side:
        step = min(span, side - span)
        # Further up, there is nothing within reach.
        for y in range(2 * reach - span - step + 1, high + 2 * reach):
            row, below = around[y], around[y + step]
            for x in range(broad):
                row[x] = row[x] if row[x] > below[x] else below[x]
        span += step
    # Sums along y, and those of all to the left.
    sums, left = np.empty(broad), np.empty(broad + 1)
    sums[:] = left[:] = 0
    means, share = np.empty((high, wide), np.float32), 1 / (side * side)
    for y in range(high + 2 * reach):
        row, old = around[y], around[y - side if y >= side else high + 4 * reach]
        for x in range(broad):
            sums[x] += np.float64(row[x]) - old[x]
        if y >= 2 * reach:
            for x in range(broad):
                left[x + 1] = left[x] + sums[x]
            right = left[side:]
            for x in range(wide):
                mean = (right[x] - left[x]) * share
                means[y - 2 * reach, x] = mean if mean > least else least
    near, far = np.float32(0.75), np.float32(0.25)
    # With a pixel more on both sides, as its neighbour.
    mixed = np.empty(wide + 2, np.float32)
    for y in range(2 * high):
        here, other = means[y // 2], means[min(max(y // 2 + 2 * (y & 1) - 1, 0), high - 1)]
        for x in range(wide):
            mixed[x + 1] = here[x] * near + other[x] * far
        mixed[0], mixed[wide + 1] = mixed[1], mixed[wide]
        for x in range(wide):
            nearby[y, 2 * x] = mixed[x] * far + mixed[x + 1] * near
            nearby[y, 2 * x + 1] = mixed[x + 1] * near + mixed[x + 2] * far
