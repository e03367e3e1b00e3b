"""How far inside the outer edge of a change a contact ends.

The mean profile of the change across the outline has a clear peak at the border of the contact. How far that
is from the outer edge differs from side to side: lamps reach one flank better than the other, and an object
leans. So each arc of the outline has a profile of its own, too. It tells how the arc differs from the others;
where the border lies on the whole is told by the profile of all of them together, which is less noisy.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel
from tactflow.vision.contact.filling import Region

Float = NDArray[np.float32]
Double = NDArray[np.float64]
Mask = NDArray[np.uint8]
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
"""What smoothing adds to that distance, pixels at half resolution. Chosen by hand."""

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
"""Width of the profile's bins, pixels at half resolution. Chosen by hand."""

MIN_BIN_PIXELS: Final = 8
MIN_ARC_PIXELS: Final = 2
"""Pixels from which on a bin of the profile counts, of the whole outline and of an arc. Chosen by hand."""

_NOTHING: Final = np.zeros((0, 0), np.uint8)
"""An empty mask."""


class Depth(NamedTuple):
    """How deep inside a region each pixel is, and what its outlines pass.

    depth : (h, w) float32, distance to what is outside, px; 0 there. nearest : (h, w) int32, label of the
    nearest pixel outside. points : (n, 2) int32, x and y of the outlines' pixels, one outline after another.
    ends, steps : (outlines + 1,) int32, 0, and how many points and steps there are up to the end of each
    outline.
    """

    depth: Float
    nearest: Whole
    points: Whole
    ends: Whole
    steps: Whole


def depth_of(region: Region) -> Depth:
    """Of a region with something outside."""
    depth, nearest = cv2.distanceTransformWithLabels(
        region.filled, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    middle = max(float(cv2.minMaxLoc(depth)[1]), 1.0)
    outlines, _ = cv2.findContours(region.filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    ends, steps = [0], [0]
    for outline in outlines:
        arcs = min(max(round(len(outline) / middle), FEWEST_ARCS), MOST_ARCS)
        ends.append(ends[-1] + len(outline))
        steps.append(steps[-1] + STEPS * arcs)
    return Depth(
        np.asarray(depth, np.float32),
        np.asarray(nearest, np.int32),
        np.asarray(np.concatenate(outlines)[:, 0], np.int32),
        np.array(ends, np.int32),
        np.array(steps, np.int32),
    )


def inside_border(region: Depth, parts: Float, strength: Float, hidden: Mask | None) -> Float:
    """Level set of a contact: how far inside its border each pixel is, pixels at half resolution.

    region : of the change. parts : (h, w), its depth, but below 0 where it does not belong to the contact.
    strength : (h, w), relative to the largest nearby. hidden : (h, w), 1 where a marker was removed; or None.
    """
    middle = float(cv2.minMaxLoc(parts)[1])
    level = np.empty_like(parts)
    border_level(
        parts,
        region.nearest,
        region.points,
        region.ends,
        region.steps,
        strength,
        _NOTHING if hidden is None else hidden,
        middle,
        np.zeros((int(region.steps[-1]) + 1, 2, int(middle / BIN) + 2)),
        level,
    )
    return level


@helper
def _crossing(profile: Double, at: Double, wanted: float) -> float:
    """Where, coming from outside, a profile first reaches a value."""
    first = 0
    while profile[first] < wanted:
        first += 1
    if first == 0:
        return float(at[0])
    fraction = (wanted - profile[first - 1]) / (profile[first] - profile[first - 1])
    return float(at[first - 1] + fraction * (at[first] - at[first - 1]))


@helper
def _border_depth(bins: Double, least: int, middle: float, otherwise: float) -> float:
    """How deep the border lies by one profile, or `otherwise` if too little of it is known.

    bins : (2, n), number of pixels and sum of their strengths in bins of depth, changed. least : pixels from
    which on a bin counts. middle : the largest depth.
    """
    counts, sums = bins[0], bins[1]
    # Bins with enough pixels, and where they are; they take the place of the others.
    known = 0
    for k in range(counts.size):
        if counts[k] >= least:
            sums[known] = sums[k] / counts[k]
            counts[known] = (k + 0.5) * BIN
            known += 1
    if known < 2:
        return otherwise
    at, profile = counts[:known], np.empty(known)
    for k in range(known):
        before, after = sums[max(k - 1, 0)], sums[min(k + 1, known - 1)]
        profile[k] = before / 4 + sums[k] / 2 + after / 4
    # The largest value before the profile falls clearly for the first time.
    peak = profile[0]
    for k in range(known):
        if profile[k] > peak:
            peak = profile[k]
        elif profile[k] < FALLEN * peak:
            break
    border, top = _crossing(profile, at, BORDER * peak), _crossing(profile, at, TOP * peak)
    soft = top - _crossing(profile, at, SKIRT * peak) - SHARP_SKIRT * (middle - top) - SKIRT_BLUR
    return min(border + SOFTNESS * max(soft, 0.0), DEEPEST * middle)


@helper
def _place_beside(points: Whole, ends: Whole, steps: Whole, nearest: Whole, parts: Float) -> Float:
    """Label of a pixel outside -> 1 and the place on the outline that it is beside, steps; 0 if none."""
    high, wide = parts.shape
    place = np.zeros(parts.size + 1, np.float32)
    for outline in range(steps.size - 1):
        first, last = ends[outline], ends[outline + 1]
        step = (steps[outline + 1] - steps[outline]) / (last - first)
        for k in range(first, last):
            mark = np.float32(1 + steps[outline] + (k - first) * step)
            for y in range(max(points[k, 1] - 1, 0), min(points[k, 1] + 2, high)):
                for x in range(max(points[k, 0] - 1, 0), min(points[k, 0] + 2, wide)):
                    if parts[y, x] <= 0:
                        place[nearest[y, x]] = max(mark, place[nearest[y, x]])
    return place


@helper
def _step_depths(bins: Double, steps: Whole, middle: float, whole: float, border: Double) -> None:
    """How deep the border lies at each step along the outlines, `whole` in the mean.

    bins : as `border_level` fills them. steps : of a `Depth`. border : (steps,), filled.
    """
    size = bins.shape[2]
    around = np.empty((2, size))
    sums = weights = 0.0
    for outline in range(steps.size - 1):
        first, last = steps[outline], steps[outline + 1]
        varies = VARIES * min((last - first) / (STEPS * FEWEST_ARCS), LEANS)
        for step in range(first, last):
            for row in range(2):
                for at in range(size):
                    around[row, at] = 0
            for beside in range(1 - STEPS, STEPS):
                share, other = 1 - abs(beside) / STEPS, first + (step + beside - first) % (last - first)
                for row in range(2):
                    for at in range(size):
                        around[row, at] += share * bins[other, row, at]
            weight = 0.0
            for at in range(size):
                weight += around[0, at]
            found = _border_depth(around, MIN_ARC_PIXELS, middle, whole)
            border[step] = min(max(found, (1 - varies) * whole), (1 + varies) * whole)
            sums, weights = sums + weight * border[step], weights + weight
    for step in range(border.size):
        border[step] += whole - sums / max(weights, 1e-9)


@kernel(
    "void(float32[:, ::1], int32[:, ::1], int32[:, ::1], int32[::1], int32[::1], float32[:, ::1],"
    " uint8[:, ::1], float64, float64[:, :, ::1], float32[:, ::1])"
)
def border_level(
    parts: Float,
    nearest: Whole,
    points: Whole,
    ends: Whole,
    steps: Whole,
    strength: Float,
    hidden: Mask,
    middle: float,
    bins: Double,
    level: Float,
) -> None:
    """What `inside_border` finds; `level` is filled.

    nearest, points, ends, steps : of a `Depth`. hidden : not 0 where a pixel does not count; (0, 0) if all
    do. middle : the largest depth. bins : (steps + 1, 2, n), 0, changed: for each step, then for all pixels,
    the number of pixels and the sum of their strengths in bins of depth.
    """
    high, wide = parts.shape
    all_pixels = bins.shape[0] - 1
    place = _place_beside(points, ends, steps, nearest, parts)
    bins_per_pixel = np.float32(1 / BIN)
    for y in range(high):
        for x in range(wide):
            if parts[y, x] > 0 and (hidden.size == 0 or hidden[y, x] == 0):
                at, step = int(parts[y, x] * bins_per_pixel), int(place[nearest[y, x]]) - 1
                bins[all_pixels, 0, at] += 1
                bins[all_pixels, 1, at] += strength[y, x]
                if step >= 0:
                    bins[step, 0, at] += 1
                    bins[step, 1, at] += strength[y, x]
    whole = _border_depth(bins[all_pixels], MIN_BIN_PIXELS, middle, 0.5)
    border = np.empty(all_pixels)
    _step_depths(bins, steps, middle, whole, border)
    for y in range(high):
        for x in range(wide):
            depth = whole
            if parts[y, x] > 0 and place[nearest[y, x]] > 0:
                depth = max(border[int(place[nearest[y, x]]) - 1], BIN)
            level[y, x] = parts[y, x] - np.float32(depth)
