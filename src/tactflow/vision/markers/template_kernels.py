"""Loops of `MarkerAppearance.measure`, for numba."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# These stand here, where numba sees that they have changed, for both ways of computing.
LEAST_REST: Final = np.float32(1e-3)
"""Square of contrast that is never explained."""
LEAST_DIVISOR: Final = np.float32(0.15)
"""Gain by which a step is divided at least: of a faint mark it would be all noise."""
ALIKE_SHARE: Final = np.float32(0.3)
ALIKE_GAIN: Final = np.float32(0.2)
"""Where less of the mark is in sight, more steps lead nowhere."""


@kernel(
    "int64(Array(uint8, 3, 'C', readonly=True), float64[:, ::1], int64[::1], float32[:, :, ::1],"
    "float32[:, :, ::1], float32[::1], int64[:, ::1], int64[::1], float64[::1], float64[:, ::1],"
    "float32[:, ::1])",
    reorder=True,
)
def measure(
    image: NDArray[np.uint8],
    start: FloatArray,
    marks: IntArray,
    weights: NDArray[np.float32],
    gram: NDArray[np.float32],
    spread: NDArray[np.float32],
    disc: IntArray,
    whole: IntArray,
    real: FloatArray,
    position: FloatArray,
    found: NDArray[np.float32],
) -> int:
    """All steps of all marks, into `position` (n, 2) and `found` (3, n): gain, share, standard error.

    image : (H, W, 3) BGR or (H, W, 1) grey. start : (n, 2). marks : (n,), of those in `weights`.
    weights : (phases^2 N, 6, P), `gram` and `spread` alike, as `MarkerAppearance` holds them.
    disc : (2, p) dx and dy of the pixels of a patch, p <= P; the other weights are zero.
    whole : reach of a patch, phases per axis, rounds after the first step. real : radius, px, length of a
    step that calls for another, px, and the sampling error, px. The number returned means nothing.
    """
    height, width, channels = image.shape
    reach, phases, rounds = whole[0], whole[1], whole[2]
    radius, converged, sampling = np.float32(real[0]), real[1] * real[1], np.float32(real[2] * real[2])
    count = weights.shape[0] // (phases * phases)
    pixels = disc.shape[1]
    flat = image.reshape(-1)
    offsets = np.empty(pixels, np.int64)
    for p in range(pixels):
        offsets[p] = (disc[1, p] * width + disc[0, p]) * channels
    words = np.empty(pixels, np.int32)
    patch = np.zeros(weights.shape[2], np.float32)
    blue, green, red, half = np.int32(3735), np.int32(19235), np.int32(9798), np.int32(16384)
    bits, middle, low = np.int32(15), np.int32(128), np.int32(255)
    byte, two_bytes, three_bytes = np.int32(8), np.int32(16), np.int32(24)
    # Unsigned indices spare numba the question whether they count from the end.
    one, two, three = np.uintp(1), np.uintp(2), np.uintp(3)
    # Patches lie far apart in memory, and waiting for one after the other takes longer than all arithmetic:
    # so first the ends of all rows are read, which the processor does for many at a time.
    touched = 0
    for n in range(len(marks)):
        left = min(max(int(start[n, 0]) - reach, 0), width - 1) * channels
        right = min(max(int(start[n, 0]) + reach, 0), width - 1) * channels
        top = min(max(int(start[n, 1]), 0), height - 1)
        for row in range(max(top - reach, 0), min(top + reach + 1, height)):
            touched += flat[np.uintp(row * width * channels + left)]
            touched += flat[np.uintp(row * width * channels + right)]
    for n in range(len(marks)):
        x, y = start[n, 0], start[n, 1]
        seen_left = seen_top = -1
        for number in range(rounds + 1):
            # Written so that NaN, too, becomes a place inside the image.
            inside_x = min(x, width - 1.0) if x > 0.0 else 0.0
            inside_y = min(y, height - 1.0) if y > 0.0 else 0.0
            quarter_x = int(inside_x * phases + phases / 2)
            quarter_y = int(inside_y * phases + phases / 2)
            left, top = quarter_x // phases, quarter_y // phases
            which = (quarter_x % phases + quarter_y % phases * phases) * count + marks[n]
            # A step of less than a pixel often sees the same patch from another phase.
            if left != seen_left or top != seen_top:
                seen_left, seen_top = left, top
                # With the pixel after it, which is read too, the patch is inside the image.
                if left >= reach and top >= reach and left + reach + 1 < width and top + reach < height:
                    base = (top * width + left) * channels
                    for p in range(pixels):
                        i = np.uintp(base + offsets[p])
                        if channels == 3:
                            # Four bytes, so that the compiler makes one load of them.
                            word = np.int32(flat[i]) | np.int32(flat[i + one]) << byte
                            word |= np.int32(flat[i + two]) << two_bytes
                            words[p] = word | np.int32(flat[i + three]) << three_bytes
                        else:
                            words[p] = np.int32(flat[i])
                else:
                    for p in range(pixels):
                        row = min(max(top + disc[1, p], 0), height - 1)
                        column = min(max(left + disc[0, p], 0), width - 1)
                        i = np.uintp((row * width + column) * channels)
                        words[p] = np.int32(flat[i])
                        if channels == 3:
                            words[p] |= np.int32(flat[i + one]) << byte
                            words[p] |= np.int32(flat[i + two]) << two_bytes
                # Grey as OpenCV makes it of BGR, less 128: far from zero, sums of squares would lose digits.
                if channels == 3:
                    for p in range(pixels):
                        level = blue * (words[p] & low) + green * ((words[p] >> byte) & low)
                        level += red * ((words[p] >> two_bytes) & low) + half
                        patch[p] = np.float32((level >> bits) - middle)
                else:
                    for p in range(pixels):
                        patch[p] = np.float32(words[p] - middle)
            weight = weights[which]
            gain = shift_x = shift_y = light = slope_x = slope_y = contrast = np.float32(0.0)
            for p in range(len(patch)):
                value = patch[p]
                gain += weight[0, p] * value
                shift_x += weight[1, p] * value
                shift_y += weight[2, p] * value
                light += weight[3, p] * value
                slope_x += weight[4, p] * value
                slope_y += weight[5, p] * value
                contrast += value * value
            product = gram[which]
            seen = gain * (product[0, 0] * gain + product[0, 1] * shift_x + product[0, 2] * shift_y)
            seen += shift_x * (product[1, 0] * gain + product[1, 1] * shift_x + product[1, 2] * shift_y)
            seen += shift_y * (product[2, 0] * gain + product[2, 1] * shift_x + product[2, 2] * shift_y)
            contrast -= light * light + slope_x * slope_x + slope_y * slope_y
            rest = max(contrast - seen, LEAST_REST)
            safe = max(gain, LEAST_DIVISOR)
            share = seen / (seen + rest)
            now_x = (quarter_x + 0.5) / phases - 0.5 + min(max(shift_x / safe, -radius), radius)
            now_y = (quarter_y + 0.5) / phases - 0.5 + min(max(shift_y / safe, -radius), radius)
            far = (now_x - x) ** 2 + (now_y - y) ** 2 > converged
            x, y = now_x, now_y
            if number == rounds or not (far and share > ALIKE_SHARE and gain > ALIKE_GAIN):
                break
        position[n, 0], position[n, 1] = x, y
        found[0, n], found[1, n] = gain, share
        found[2, n] = np.sqrt(rest * spread[which] / (safe * safe) + sampling)
    return touched
