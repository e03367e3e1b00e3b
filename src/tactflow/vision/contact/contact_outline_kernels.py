"""Compiled loops of `imprint`: what they compute is written with numpy and OpenCV there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import kernel

Float = NDArray[np.float32]
Double = NDArray[np.float64]
Byte = NDArray[np.uint8]
Whole = NDArray[np.int32]


@kernel("void(float32[:, ::1], float32[:, ::1], float32, float32, float32, float64[::1])", reorder=True)
def cap_change(strength: Float, common: Float, sign: float, cap: float, even: float, summary: Double) -> None:
    """Cut `strength` to `cap`, and `sign` times `common` to `even`, in place; summary : sums of squares."""
    strengths = tones = 0.0
    for y in range(strength.shape[0]):
        length, tone = strength[y], common[y]
        for x in range(strength.shape[1]):
            length[x] = length[x] if length[x] < cap else cap
            tone[x] = sign * tone[x] if sign * tone[x] < even else even
            strengths += length[x] * length[x]
            tones += tone[x] * tone[x]
    summary[0], summary[1] = strengths, tones


@kernel("void(float32[:, ::1], int64, int64, uint8[:, ::1])")
def raise_level(level: Float, top: int, left: int, mask: Byte) -> None:
    """Set to 255 the pixels of `mask` where `level`, interpolated to twice its size, is positive.

    level : (h, w), from row `top` and column `left` of the mask on, of which it may reach over the border.
    """
    high, wide = level.shape
    near, far = np.float32(0.75), np.float32(0.25)
    line = np.empty(2 * wide, np.float32)
    mixed = np.empty(wide, np.float32)
    for y in range(min(2 * high, mask.shape[0] - top)):
        here, other = level[y // 2], level[min(max(y // 2 + 2 * (y & 1) - 1, 0), high - 1)]
        for x in range(wide):
            mixed[x] = here[x] * near + other[x] * far
        for x in range(1, wide):
            line[2 * x] = mixed[x] * near + mixed[x - 1] * far
            line[2 * x - 1] = mixed[x - 1] * near + mixed[x] * far
        line[0], line[2 * wide - 1] = mixed[0], mixed[wide - 1]
        row = mask[top + y, left:]
        for x in range(min(2 * wide, row.size)):
            row[x] |= np.uint8(255) if line[x] > 0 else np.uint8(0)


@kernel("void(float32[:, ::1], uint8[:, ::1], float32, float32)")
def settle_level(level: Float, filled: Byte, most: float, scale: float) -> None:
    """Make `level` positive where `filled` is 1, else negative, at most `most`; scale it; in place."""
    for y in range(level.shape[0]):
        row, inside = level[y], filled[y]
        for x in range(level.shape[1]):
            value = row[x] if row[x] < most else most
            side = most if inside[x] != 0 else -most
            row[x] = scale * (value if (value > 0) == (inside[x] != 0) else side)


@kernel("void(uint8[:, ::1], int64, int64, uint8[:, ::1], uint8[:, ::1])")
def halve_window(mask: Byte, top: int, left: int, inside: Byte, halved: Byte) -> None:
    """1 where any of 2 x 2 pixels of a window of `mask` is not 0 and its cell of 4 x 4 is inside, else 0.

    top, left : of the window. inside : (h / 2, w / 2). halved : (h, w), filled; the window may reach over the
    border of the mask, where nothing is.
    """
    high = min(halved.shape[0], (mask.shape[0] - top + 1) // 2)
    wide = min(halved.shape[1], (mask.shape[1] - left + 1) // 2)
    halved[:] = 0
    for y in range(high):
        first, row = top + 2 * y, halved[y]
        upper, lower = mask[first, left:], mask[min(first + 1, mask.shape[0] - 1), left:]
        cells = inside[y // 2]
        whole = min(wide, upper.size // 2)
        for x in range(whole):
            any_of = upper[2 * x] | upper[2 * x + 1] | lower[2 * x] | lower[2 * x + 1]
            row[x] = np.uint8((any_of != 0) & (cells[x // 2] != 0))
        for x in range(whole, wide):
            row[x] = np.uint8(((upper[2 * x] | lower[2 * x]) != 0) & (cells[x // 2] != 0))


@kernel(
    "int64(int32[:, ::1], uint8[:, ::1], float64[:, ::1], float64, int64, float64, int32[:, ::1])",
)
def continue_outline(
    outline: Whole, hidden: Byte, cubics: Double, inwards: float, tangent: int, turn: float, line: Whole
) -> int:
    """Replace the hidden parts of an outline, (n, 2), by cubics; `line` is filled.

    hidden : mask of what is not seen. cubics : (m, 4), Hermite's. The other constants are `imprint`'s.
    Returns the number of points of the line, 0 if all is hidden, -1 if nothing is. `line` has room for
    n + (n // 2) * m points, since each hidden part has a seen point before it.
    """
    count = len(outline)
    below = np.empty(count, np.bool_)
    unseen = 0
    for i in range(count):
        below[i] = hidden[outline[i, 1], outline[i, 0]] != 0
        unseen += below[i]
    if unseen == 0:
        return -1
    if unseen == count:
        return 0
    # Begin behind a hidden part, so that no seen part is cut in two.
    start = 0
    while below[start] or not below[start - 1 if start > 0 else count - 1]:
        start += 1
    filled = 0
    at = 0
    seen_from = 0
    while at < count:
        here = (start + at) % count
        if not below[here]:
            line[filled, 0], line[filled, 1] = outline[here, 0], outline[here, 1]
            filled += 1
            at += 1
            continue
        behind = at
        while behind < count and below[(start + behind) % count]:
            behind += 1
        # A seen part ends where the next hidden one begins; the last hidden part is followed by the first.
        seen_to = behind + 1
        while seen_to - behind <= tangent and not below[(start + seen_to) % count]:
            seen_to += 1
        since = (start + max(at - 1 - tangent, seen_from)) % count
        until = (start + min(behind + tangent, seen_to - 1)) % count
        first, last = (start + at - 1) % count, (start + behind) % count
        x0, y0 = float(outline[first, 0]), float(outline[first, 1])
        x1, y1 = float(outline[last, 0]), float(outline[last, 1])
        chord_x, chord_y = x1 - x0, y1 - y0
        square = chord_x * chord_x + chord_y * chord_y
        ax, ay = x0 - outline[since, 0], y0 - outline[since, 1]
        bx, by = outline[until, 0] - x1, outline[until, 1] - y1
        # Directions at both ends, as long as the chord, and the cosines of their angles to it.
        scale = math.sqrt(square / max(ax * ax + ay * ay, 1e-9))
        ax, ay = ax * scale, ay * scale
        scale = math.sqrt(square / max(bx * bx + by * by, 1e-9))
        bx, by = bx * scale, by * scale
        along_a = (ax * chord_x + ay * chord_y) / max(square, 1e-9)
        along_b = (bx * chord_x + by * chord_y) / max(square, 1e-9)
        if min(along_a, along_b) > turn:
            # With tangents of this length, equal angles at both ends make a curve as high as an arc.
            arc = 4 / max(2 + along_a + along_b, 1.0)
            ax, ay, bx, by = ax * arc, ay * arc, bx * arc, by * arc
        else:
            ax, ay, bx, by = chord_x, chord_y, chord_x, chord_y
        inner = inwards / math.sqrt(max(square, 1.0))
        for k in range(len(cubics)):
            c0, c1, c2, c3 = cubics[k, 0], cubics[k, 1], cubics[k, 2], cubics[k, 3]
            x = c0 * x0 + c1 * ax + c2 * x1 + c3 * bx + chord_y * inner
            y = c0 * y0 + c1 * ay + c2 * y1 + c3 * by - chord_x * inner
            line[filled, 0], line[filled, 1] = int(np.rint(x)), int(np.rint(y))
            filled += 1
        seen_from = behind
        at = behind
    return filled


@kernel(
    "void(float32[:, ::1], float32[:, ::1], uint8[:, ::1], int64, float32, int64[::1], float64[::1])",
)
def sum_profile(
    depth: Float,
    strength: Float,
    hidden: Byte,
    every: int,
    scale: float,
    counts: NDArray[np.int64],
    sums: Double,
) -> None:
    """Number and sum of the strengths at each depth, of every so many rows; both are added to.

    scale : bins per pixel of depth. hidden : what does not count; (0, 0) if all does.
    """
    for y in range(0, depth.shape[0], every):
        deep, strong = depth[y], strength[y]
        for x in range(depth.shape[1]):
            if deep[x] > 0 and (hidden.size == 0 or hidden[y, x] == 0):
                at = int(deep[x] * scale)
                counts[at] += 1
                sums[at] += strong[x]
