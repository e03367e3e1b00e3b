"""How far inside the outer edge of a change a contact ends.

The mean profile of the change across the outline has a clear peak at the border of the contact. How far that
is from the outer edge differs from side to side: lamps reach one flank better than the other, and an object
leans. So each arc of the outline has a profile of its own, too. It tells how the arc differs from the others;
where the border lies on the whole is told by the profile of all of them together, which is less noisy.

`depth_of` gives the depth of each pixel of a region, and the outlines; `inside_border` subtracts the depth of
the border. An outline is divided into steps, several to an arc: a pixel outside gets the step that it lies
beside (`_steps_beside`), a pixel inside that of the nearest pixel outside. So each step has a profile; those
within an arc's length, together, tell how deep the border lies there (`_step_depths`).

Lengths are in pixels of the contact's window, which has the frame's resolution or half of it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats, Floats32, Mask
from tactflow.vision.compiled import helper, kernel
from tactflow.vision.contact.filling import Region

Whole = NDArray[np.int32]

BORDER: Final = 0.85
"""The contact ends where the mean profile reaches this fraction of its peak: outside a contact the slope is
about 0.6 of that inside, and half way between the two, blurred, is the border of a small contact's narrow
ridge."""

FALLEN: Final = 0.9
"""Fraction of a peak of the profile below which the peak is over, and what lies further in, such as the
relief of an object, has none to do with the border. Chosen by hand."""

TOP: Final = 0.9
"""Fraction of its peak up to which the width of the profile's skirt is measured. Chosen by hand."""

SKIRT: Final = 0.6
"""Fraction of its peak to which the mean profile has fallen in the surroundings of the contact.
Chosen by hand."""

SHARP_SKIRT: Final = 0.11
"""Distance from there to the top where the slope breaks at the border, as on a half-space (Hertz), in half
widths of the contact."""

SKIRT_BLUR: Final = 0.9
"""What smoothing adds to that distance, pixels of the window. Chosen by hand."""

SOFTNESS: Final = 3.5
"""Where the distance is larger, the gel is coated or soft and the slope has no break: the peak of the profile
is as blunt as its skirt is wide, and `BORDER` is reached too early by so many times the excess. Chosen on
mini_ball, whose radii are then 3 % too large in the median."""

DEEPEST: Final = 0.4
"""The border is sought no further in than this part of the way to the middle: where an object is not round,
the profile is a mean of borders at several depths. Chosen by hand; a ball's border lies at 0.25 to 0.4."""

FEWEST_ARCS: Final = 6
MOST_ARCS: Final = 16
"""An arc is as long as the contact is deep, which makes six of a disc's outline; of a long contact's at most
sixteen. Chosen on the simulator and mini_ball: with ten around a disc, noise moves the outline."""

STEPS: Final = 6
"""Places in each arc's length for which a profile is taken, from an arc's length to both sides, where what is
nearer counts more: so it does not matter where an outline begins."""

VARIES: Final = 0.2
LEANS: Final = 1.5
"""Part of the depth of the whole outline's border by which that of an arc of a disc may differ; and how many
times as much that of a long contact may, in proportion to its arcs, since it may lean to one side. Chosen on
the simulator, wedge_ball and mini_ball."""

BIN: Final = 0.5
"""Width of the profile's bins, pixels of the window. Chosen by hand."""

MIN_BIN_PIXELS: Final = 8
MIN_ARC_PIXELS: Final = 2
"""Pixels from which on a bin of the profile counts, of the whole outline and of an arc. Chosen by hand."""

LEVELS: Final = (SKIRT, TOP, BORDER)
"""Fractions of its peak at which a profile is measured."""


class RegionDepth(NamedTuple):
    """How deep inside a region each pixel is, and its outlines.

    depth : (h, w) float32, distance to what is outside, px; 0 there. nearest : (h, w) int32, label of the
    nearest pixel outside. middle : the largest depth. corners : (n, 2) int32, x and y of the pixels where
    outlines turn, one outline after another. outlines : (outlines + 1, 3) int32, 0, and at the end of each
    outline, how many corners and steps there are so far, and how many pixels it passes.
    """

    depth: Floats32
    nearest: Whole
    middle: float
    corners: Whole
    outlines: Whole


def depth_of(region: Region) -> RegionDepth:
    """Of a region with something outside."""
    depth, nearest = cv2.distanceTransformWithLabels(
        region.filled, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    middle, outlines, ends = cv2.minMaxLoc(depth)[1], region.outlines, [(0, 0, 0)]
    corners = np.concatenate(outlines) if len(outlines) > 1 else outlines[0]
    for outline in outlines:
        # From one corner to the next, and back to the first, along rows, columns and diagonals.
        steps = np.abs(np.diff(outline[:, 0], axis=0, append=outline[:1, 0]))
        length = max(int(steps.max(axis=1).sum()), 1)
        arcs = min(max(round(length / max(middle, 1.0)), FEWEST_ARCS), MOST_ARCS)
        ends.append((ends[-1][0] + len(outline), ends[-1][1] + STEPS * arcs, length))
    return RegionDepth(
        np.asarray(depth, np.float32),
        np.asarray(nearest, np.int32),
        middle,
        corners.reshape(-1, 2),
        np.array(ends, np.int32),
    )


def inside_border(inner: RegionDepth, parts: Floats32, strength: Floats32, hidden: Mask | None) -> Floats32:
    """Level set of a contact: how far inside its border each pixel is, pixels of the window.

    inner : of the changed region. parts : (h, w), its depth, but below 0 where it does not belong to the
    contact. strength : (h, w), relative to the largest nearby. hidden : (h, w), 1 where a marker was removed;
    or None.
    """
    middle = inner.middle if parts is inner.depth else cv2.minMaxLoc(parts)[1]
    level = np.empty_like(parts)
    border_level(
        parts,
        inner.nearest,
        inner.corners,
        inner.outlines,
        strength,
        np.zeros(parts.shape, np.uint8) if hidden is None else hidden,
        middle,
        level,
    )
    return level


@helper
def _border_depth(
    bins: Floats, least: int, middle: float, otherwise: float, at: Floats, profile: Floats
) -> float:
    """How deep the border lies by one profile, or `otherwise` if too little of it is known.

    bins : (2 n,), number of pixels and sum of their strengths in bins of depth, in turns. least : pixels from
    which on a bin counts. middle : the largest depth. at, profile : (n,) or more, changed.
    """
    # Bins with enough pixels: where they are, and what they hold.
    known, peak = 0, 0.0
    for k in range(bins.size // 2):
        if bins[2 * k] >= least:
            at[known], profile[known] = (k + 0.5) * BIN, bins[2 * k + 1] / bins[2 * k]
            known += 1
    if known < 2:
        return otherwise
    # Smoothed, up to where the profile falls clearly for the first time; the largest value before.
    before = profile[0]
    for k in range(known):
        here, after = profile[k], profile[min(k + 1, known - 1)]
        profile[k], before = before / 4 + here / 2 + after / 4, here
        if profile[k] < FALLEN * peak:
            break
        if profile[k] > peak:
            peak = profile[k]
    # Where, coming from outside, it first reaches each of the levels.
    skirt = top = border = 0.0
    for level in LEVELS:
        wanted, first = level * peak, 0
        while profile[first] < wanted:
            first += 1
        skirt, top, border = top, border, at[first]
        if first > 0:
            step = profile[first] - profile[first - 1]
            border = at[first - 1] + (wanted - profile[first - 1]) / step * (at[first] - at[first - 1])
    soft = top - skirt - SHARP_SKIRT * (middle - top) - SKIRT_BLUR
    return min(border + SOFTNESS * max(soft, 0.0), DEEPEST * middle)


@helper
def _steps_beside(corners: Whole, outlines: Whole, nearest: Whole, parts: Floats32, beside: Whole) -> None:
    """Label of a pixel outside -> 1 and the step of the outline that it is beside; `beside`, 0, is filled."""
    high, wide = parts.shape
    for outline in range(1, outlines.shape[0]):
        first, last, length = outlines[outline - 1, 0], outlines[outline, 0], outlines[outline, 2]
        steps, ahead = outlines[outline - 1, 1], first
        x, y = corners[first, 0], corners[first, 1]
        step = (outlines[outline, 1] - steps) / length
        for k in range(length):
            mark = int(np.float32(1 + steps + k * step))
            for row in range(max(y - 1, 0), min(y + 2, high)):
                for column in range(max(x - 1, 0), min(x + 2, wide)):
                    if parts[row, column] <= 0:
                        label = nearest[row, column]
                        beside[label] = max(mark, beside[label])
            if x == corners[ahead, 0] and y == corners[ahead, 1]:
                ahead = ahead + 1 if ahead + 1 < last else first
            across, down = corners[ahead, 0] - x, corners[ahead, 1] - y
            x += min(max(across, -1), 1)
            y += min(max(down, -1), 1)


@helper
def _step_depths(bins: Floats, outlines: Whole, middle: float, around: Floats, border: Floats) -> float:
    """How deep the border lies at each step along the outlines, and in the mean, which is returned.

    bins : (steps, n), as `border_level` fills them. around : (n,), the profile of all pixels, changed.
    border : (steps,), filled.
    """
    whole, sums, weights, outline = 0.5, 0.0, 0.0, 1
    at, means = np.empty(around.size), np.empty(around.size)
    # First of all pixels together.
    for step in range(-1, border.size):
        if step == outlines[outline, 1]:
            outline += 1
        first, last, weight = outlines[outline - 1, 1], outlines[outline, 1], 0.0
        if step >= 0:
            # The sum of the profiles near a step; what is nearer counts more.
            around[:] = 0
            for beside in range(1 - STEPS, STEPS):
                other, share = step + beside, 1 - abs(beside) / STEPS
                if other < first:
                    other += last - first
                if other >= last:
                    other -= last - first
                profile = bins[other]
                for k in range(around.size):
                    around[k] += share * profile[k]
        for k in range(0, around.size, 2):
            weight += around[k]
        least = MIN_ARC_PIXELS if step >= 0 else MIN_BIN_PIXELS
        found = _border_depth(around, least, middle, whole, at, means)
        if step < 0:
            whole = found
        else:
            varies = VARIES * min((last - first) / (STEPS * FEWEST_ARCS), LEANS)
            border[step] = min(max(found, (1 - varies) * whole), (1 + varies) * whole)
            sums, weights = sums + weight * border[step], weights + weight
    for step in range(border.size):
        border[step] = max(border[step] + whole - sums / max(weights, 1e-9), BIN)
    return whole


@kernel(
    "void(float32[:, ::1], int32[:, ::1], int32[:, ::1], int32[:, ::1], float32[:, ::1], uint8[:, ::1],"
    " float64, float32[:, ::1])"
)
def border_level(
    parts: Floats32,
    nearest: Whole,
    corners: Whole,
    outlines: Whole,
    strength: Floats32,
    hidden: Mask,
    middle: float,
    level: Floats32,
) -> None:
    """What `inside_border` finds; `level` is filled.

    nearest, corners, outlines : of a `RegionDepth`. hidden : not 0 where a pixel does not count.
    middle : the largest depth of the parts.
    """
    high, wide = parts.shape
    beside = np.empty(parts.size + 1, np.int32)
    beside[:] = 0
    _steps_beside(corners, outlines, nearest, parts, beside)
    # Of all pixels, and of those of each step: their number and the sum of their strengths in bins of depth.
    steps, around = outlines[-1, 1], np.empty(2 * int(middle / BIN) + 4)
    bins, border = np.empty((steps, around.size)), np.empty(steps)
    around[:] = bins[:] = 0
    bins_per_pixel = np.float32(1 / BIN)
    for y in range(high):
        for x in range(wide):
            if parts[y, x] > 0:
                step = beside[nearest[y, x]] - 1
                level[y, x] = step
                if hidden[y, x] == 0:
                    at = 2 * int(parts[y, x] * bins_per_pixel)
                    around[at] += 1
                    around[at + 1] += strength[y, x]
                    if step >= 0:
                        bins[step, at] += 1
                        bins[step, at + 1] += strength[y, x]
    whole = _step_depths(bins, outlines, middle, around, border)
    for y in range(high):
        for x in range(wide):
            depth = whole
            if parts[y, x] > 0 and level[y, x] >= 0:
                depth = border[int(level[y, x])]
            level[y, x] = parts[y, x] - np.float32(depth)
