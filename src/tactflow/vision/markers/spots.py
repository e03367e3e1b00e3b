"""Spots of one scale: peaks of a difference of Gaussians that differ from their surroundings."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats

SCALE_RATIO: Final = 1.6
"""Width of the wider Gaussian of a difference of Gaussians over that of the narrower: closest to the
Laplacian of a Gaussian (Marr and Hildreth 1980)."""

RADIUS_PER_SIGMA: Final = 1.83
"""Radius of the disc with the strongest response, over the narrower width. Measured on rendered discs of
radius 2 to 12 px."""

MIN_SIGMA_PX: Final = 0.75
"""Smallest scale, px: marks of radius 1.4. Chosen by hand."""

SIGMA_STEP: Final = 1.2
"""Ratio of adjacent scales. Chosen by hand."""

MAX_SIGMA_SHARE: Final = 1 / 16
"""Largest scale, over the shorter side of the image. Chosen by hand."""

SAME_SIZE_RATIO: Final = 1.3
"""Largest ratio of the radii of marks that count as equal in size: the uncertainty of one step of scale
either way. Up to 1.6 it changes no identity in seven recordings (measured)."""

FULL_SIZE_SIGMA_PX: Final = 4.0
"""Scales from this one on are computed in a shrunk picture, px: the peaks are the same at a bounded cost."""

MIN_STRENGTH_GREY: Final = 1.0
"""Minimum response of a spot, grey levels: weaker ones are rounding."""

MAX_PEAKS: Final = 3000
"""Maximum number of peaks of one scale, the strongest ones: bounds the time on a textured picture."""

RING_RADII: Final = 1.9
"""Radius of the ring that a spot is compared with, in radii of the spot. Chosen by hand."""

RING_POINTS: Final = 16
"""Number of points of that ring. Chosen by hand."""

MAX_RING_MISSES: Final = 2
"""Number of points of the ring that need not differ from the spot, where something touches it. Chosen by
hand."""

MIN_PEAK_SPACING_RADII: Final = 1.3
"""Minimum distance of neighbouring marks, in radii: closer spots are ridges of a pattern."""

BORDER_MARGIN_RADII: Final = 0.8
"""Minimum distance of a mark from the border of the image, in radii: closer ones are cut by it."""


class Spots(NamedTuple):
    """Spots and their properties.

    Attributes
    ----------
    points : (N, 2) float64, px.
    radius : (N,) float64, of discs of that scale, px.
    strength : (N,) float64, response, grey levels.
    clear : (N,) float64, smallest contrast with the surrounding ring over the median one, at most 1; an
        isolated spot on an even background has 1.
    bend : (N,) float64, smallest curvature of the peak of the response, grey levels per squared scale.
    """

    points: Floats
    radius: Floats
    strength: Floats
    clear: Floats
    bend: Floats

    def at(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Spots:
        """A selection of the spots, by index or by (N,) bool."""
        return Spots(*(values[which] for values in self))


def joined(*parts: Spots) -> Spots:
    """Concatenate spots."""
    return Spots(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def sigmas(dot_radius: float | None, shortest: int) -> list[float]:
    """Scales to search, px: that of one radius, or all that fit a picture with this shorter side."""
    if dot_radius is not None:
        return [dot_radius / RADIUS_PER_SIGMA]
    largest = max(SIGMA_STEP, shortest * MAX_SIGMA_SHARE)
    count = 1 + int(np.floor(np.log(largest / MIN_SIGMA_PX) / np.log(SIGMA_STEP)))
    return [MIN_SIGMA_PX * SIGMA_STEP**step for step in range(count)]


def find_spots(
    gray: NDArray[np.float32],
    sigma: float,
    polarity: Literal["dark", "bright"],
    valid: NDArray[np.uint8] | None = None,
) -> Spots:
    """Spots of one scale and polarity, strongest first, without those that the border cuts.

    Edges and lines also answer to a difference of Gaussians, but are as dark along themselves: `clear` tells
    whether a spot differs from (almost) the whole ring around it, `bend` whether it is part of no line.

    gray : (H, W) float32, grey levels. sigma : px. valid : (H, W) uint8, not 0 where there is gel.

    References
    ----------
    Lindeberg, "Feature detection with automatic scale selection", IJCV 30 (1998); Lowe, "Distinctive image
    features from scale-invariant keypoints", IJCV 60 (2004), for the difference of Gaussians.
    """
    factor, smooth, response = _respond(gray, sigma, polarity, FULL_SIZE_SIGMA_PX)
    fine, radius = sigma / factor, sigma * RADIUS_PER_SIGMA
    # Marks do not overlap: peaks that are nearer to each other are the border of one spot of a larger scale.
    peaks, strength = _peaks(response, MIN_STRENGTH_GREY, MIN_PEAK_SPACING_RADII * radius / factor)
    strongest = np.argsort(-strength, kind="stable")[:MAX_PEAKS]
    peaks, strength = peaks[strongest], strength[strongest]
    clear = _clearance(smooth, peaks, radius / factor)
    points = peaks * factor + (factor - 1) / 2
    spots = Spots(points, np.full(len(points), radius), strength, clear, fine**2 * _bend(response, peaks))
    margin, (height, width) = BORDER_MARGIN_RADII * radius, gray.shape
    inside = ((points >= margin) & (points <= np.array([width, height]) - 1 - margin)).all(axis=1)
    spots = spots.at(np.flatnonzero(inside))
    return spots if valid is None else spots.at(_on_gel(valid, spots.points, radius))


def find_peaks(
    gray: NDArray[np.float32], sigma: float, polarity: Literal["dark", "bright"], least: float
) -> tuple[Floats, Floats]:
    """Peaks (M, 2) float64, px, of at least that response, whatever lies around them, and their responses.

    Of those within a radius of each other, as of marks that touch under pressure, the highest one counts.

    gray : (H, W) float32, grey levels. sigma : px. least : grey levels. Returns (M, 2), (M,) float64.
    """
    # At half the resolution of detection: where they are is measured by templates.
    factor, _, response = _respond(gray, sigma, polarity, FULL_SIZE_SIGMA_PX / 2)
    peaks, strength = _peaks(response, least, RADIUS_PER_SIGMA * sigma / factor)
    return peaks * factor + (factor - 1) / 2, strength


def _respond(
    gray: NDArray[np.float32], sigma: float, polarity: Literal["dark", "bright"], full_size: float
) -> tuple[int, NDArray[np.float32], NDArray[np.float32]]:
    """Shrink factor (above 1 for scales from `full_size` px on), the shrunk picture at the scale, with dark
    marks, and its difference of Gaussians, positive on marks."""
    factor = 1
    while sigma >= factor * full_size:
        factor *= 2
    height, width = gray.shape[0] // factor, gray.shape[1] // factor
    if factor > 1:
        whole = gray[: height * factor, : width * factor]
        gray = np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    fine = sigma / factor
    narrow = cv2.GaussianBlur(gray, (0, 0), fine, borderType=cv2.BORDER_REPLICATE)
    step = fine * float(np.sqrt(SCALE_RATIO**2 - 1.0))
    wide = cv2.GaussianBlur(narrow, (0, 0), step, borderType=cv2.BORDER_REPLICATE)
    sign = np.float32(1 if polarity == "dark" else -1)
    return factor, np.asarray(sign * narrow), np.asarray(sign * (wide - narrow))


def _peaks(response: NDArray[np.float32], least: float, reach: float) -> tuple[Floats, Floats]:
    """Pixels above `least` that are the highest in a square that extends `reach` px from them, at least one.

    Returns (M, 2) float64, each the vertex of a parabola along each axis, at most half a pixel away, and the
    response (M,) float64.
    """
    side = 2 * max(1, round(reach)) + 1
    highest = cv2.dilate(response, np.ones((side, side), np.uint8))
    peak = (response >= highest) & (response > np.float32(least))
    peak[[0, -1]] = False
    peak[:, [0, -1]] = False
    rows, columns = np.nonzero(peak)
    # Pixels of one peak that are equally high count once.
    _, first = np.unique(cv2.connectedComponents(peak.view(np.uint8))[1][rows, columns], return_index=True)
    rows, columns = rows[first], columns[first]
    value = response[rows, columns].astype(np.float64)
    points = np.column_stack([columns, rows]).astype(np.float64)
    for axis, (step_y, step_x) in enumerate(((0, 1), (1, 0))):
        before = response[rows - step_y, columns - step_x]
        after = response[rows + step_y, columns + step_x]
        bend = np.minimum(before + after - 2 * value, -1e-6)
        points[:, axis] += np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return points, value


def _bend(response: NDArray[np.float32], peaks: Floats) -> Floats:
    """How fast the response falls from its peaks (N, 2), px, where it falls least: (N,), grey levels per px².

    It is the lesser eigenvalue of minus the matrix of second derivatives, and 0 along an edge or a line.
    """
    limits = np.array([response.shape[1] - 2, response.shape[0] - 2])
    columns, rows = np.clip(np.rint(peaks).astype(np.int64), 1, limits).T

    def at(down: int, right: int) -> Floats:
        return np.asarray(response[rows + down, columns + right], np.float64)

    peak = 2 * at(0, 0)
    across, down = peak - at(0, -1) - at(0, 1), peak - at(-1, 0) - at(1, 0)
    mixed = (at(-1, -1) + at(1, 1) - at(-1, 1) - at(1, -1)) / 4
    return np.asarray((across + down - np.hypot(across - down, 2 * mixed)) / 2, np.float64)


def _clearance(smooth: NDArray[np.float32], peaks: Floats, radius: float) -> Floats:
    """Contrast of dark peaks with all but `MAX_RING_MISSES` points of the ring, over the median one."""
    if len(peaks) == 0:
        return np.zeros(0)
    angles = np.arange(RING_POINTS) * (2 * np.pi / RING_POINTS)
    ring = peaks[:, None] + RING_RADII * radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    limits = np.array([smooth.shape[1] - 1, smooth.shape[0] - 1])
    ring = np.rint(ring).astype(np.int64)
    column, row = np.clip(ring, 0, limits).transpose(2, 0, 1)
    own_column, own_row = np.clip(np.rint(peaks).astype(np.int64), 0, limits).T
    above = smooth[row, column] - smooth[own_row, own_column][:, None]
    # What the ring meets beyond the border is not known, and says nothing.
    inside = ((ring >= 0) & (ring <= limits)).all(axis=2)
    above = np.sort(np.where(inside, above, np.float32(np.inf)), axis=1)
    half = np.maximum(inside.sum(axis=1) // 2, MAX_RING_MISSES)
    median = np.take_along_axis(above, half[:, None], axis=1)[:, 0]
    median = np.where(np.isfinite(median), median, 0.0)
    return np.asarray(
        np.where(median > 0, above[:, MAX_RING_MISSES] / np.maximum(median, 1e-3), 0.0), np.float64
    )


def _on_gel(valid: NDArray[np.uint8], points: Floats, radius: float) -> NDArray[np.bool_]:
    """Which points have gel in at least half of the square around them."""
    side = 2 * round(RING_RADII * radius) + 1
    share = cv2.boxFilter((valid > 0).astype(np.float32), -1, (side, side), borderType=cv2.BORDER_REPLICATE)
    limits = np.array([valid.shape[1] - 1, valid.shape[0] - 1])
    column, row = np.clip(np.rint(points).astype(np.int64), 0, limits).T
    return np.asarray(share[row, column] >= 0.5)
