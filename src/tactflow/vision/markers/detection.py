"""Find the printed marks of a gel: sub-pixel centres, their size, their polarity and their neighbours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Polarity = Literal["auto", "dark", "bright"]
FloatArray = NDArray[np.float64]

SCALE_RATIO: Final = 1.6
"""Width of the wider Gaussian of a difference of Gaussians over that of the narrower: closest to the
Laplacian of a Gaussian (Marr and Hildreth 1980)."""

RADIUS_PER_SIGMA: Final = 1.83
"""Radius of the disc that such a difference answers most strongly, over the narrower width. Measured on
rendered discs of radius 2 to 12 px."""

LEAST_SIGMA: Final = 0.9
"""Smallest scale that is looked at, px: marks of radius 1.6. Chosen by hand."""

SIGMA_STEP: Final = 1.2
"""Ratio of neighbouring scales. Chosen by hand."""

LARGEST_MARK: Final = 1 / 16
"""Largest scale that is looked at, over the shorter side of the image. Chosen by hand."""

FULL_SIZE_SIGMA: Final = 4.0
"""Scales from here on are looked at in a smaller picture, px: it gives the same peaks at a cost that does not
grow."""

LEAST_RESPONSE: Final = 1.0
"""Response of a peak, grey levels, at least: below it is rounding."""

MOST_PEAKS: Final = 3000
"""Peaks of one scale, the strongest ones: bounds the time on a textured picture."""

RING: Final = 1.9
"""Radius of the ring around a mark that is compared with it, in radii of the mark. Chosen by hand."""

RING_POINTS: Final = 8
"""Points of that ring. Chosen by hand."""

RING_CONTRAST: Final = 0.3
"""Contrast of a spot with all but one point of the ring, at least, over the median contrast. Chosen by
hand."""

OVERLAP: Final = 1.3
"""Distance of neighbouring marks at least, in radii: spots closer than that are ridges of a pattern."""

BORDER_MARGIN: Final = 0.8
"""Distance of a mark from the border of the image at least, in radii: others are cut by it."""

FAMILY_STRENGTH: Final = 0.35
"""Response of a mark over that of the typical one, at least. Chosen by hand: dirt and grain are a tail."""

LEAST_STRENGTH: Final = 2.0
"""Response of a mark, grey levels, at least. Chosen by hand."""

BETWEEN: Final = 0.55
"""Distance, pitches, below which the weaker of two spots lies between marks. Chosen by hand."""

LONELY: Final = 2.3
"""Distance of the second nearest mark, pitches, beyond which a spot is lonely. Chosen by hand."""

ENOUGH_MARKS: Final = 100
"""Marks from which on more make a family no better. Chosen by hand."""

LEAST_SCORE: Final = 25.0
"""Score of the weakest family that is believed to be marks (see `_score`). Real and simulated gels score 100
and more; dust, reflections and noise on gels without marks at most 14 (measured)."""

LONGEST_LINK: Final = 2.6
"""Distance of neighbours at most, pitches. Chosen by hand."""

LONE_PITCH: Final = 8.0
"""Pitch of a single mark, in radii. Chosen by hand."""

CENTROID_WINDOW: Final = 1.6
"""Radius of the window of a centroid, in radii of the mark. Chosen by hand: it holds the mark's border."""

SURROUNDINGS: Final = (1.4, 1.9)
"""Inner and outer radius of the ring that gives the level around a mark, in radii of the mark; the outer one
is 1.5 px wider. Chosen by hand."""

CENTROID_ROUNDS: Final = 4
"""Steps of a centroid's window, at most. Chosen by hand."""

CENTROID_CONVERGED: Final = 1e-3
"""Step of all windows, px, below which they have converged. Chosen by hand: a tenth of a
marker's error."""

BLOCKING: Final = 1.1
"""Sum of squares, over the squared distance of two marks, below which a third one between them blocks their
link. A right angle has 1; a tenth more keeps a skewed square free of diagonals. Chosen by hand."""

GRAPH_CANDIDATES: Final = 12
"""Nearest marks among which neighbours are looked for. Chosen by hand."""

_NO_MARKERS: Final = "0 markers found: is the sensor marker-less? then use pipelines/markerless.yaml"
_FEW_MARKERS: Final = " (if it has only a few marks, give their radius in pixels)"


class NoMarkersError(ValueError):
    """The image shows no marks that could be tracked."""


@dataclass(frozen=True, slots=True)
class Detection:
    """The marks of an image.

    centers : (N, 2) float64, px. dot_radius : of a disc that answers like the marks, px.
    polarity : whether the marks are darker or brighter than the gel.
    pitch : median distance of a mark to its nearest neighbour, px; with one mark, eight radii.
    edges : (E, 2) int64, pairs of neighbouring marks, each pair once, smaller index first.
    """

    centers: FloatArray
    dot_radius: float
    polarity: Literal["dark", "bright"]
    pitch: float
    edges: NDArray[np.int64]


def require_image(image: NDArray[np.uint8]) -> None:
    """Raises ValueError for anything but (H, W, 3) or (H, W) uint8, not empty."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(
            f"required image to be (H, W, 3) or (H, W) uint8, got shape {image.shape}, dtype {image.dtype}"
        )
    if min(image.shape[:2]) < 1:
        raise ValueError(f"required a non-empty image, got shape {image.shape}")


def to_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR, or (H, W) uint8, to (H, W) uint8 luma; raises ValueError on anything else.

    >>> to_gray(np.full((2, 2, 3), 7, np.uint8)).tolist()
    [[7, 7], [7, 7]]
    """
    require_image(image)
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2GRAY), np.uint8)


def detect_markers(
    image: NDArray[np.uint8],
    *,
    dot_radius: float | None = None,
    polarity: Polarity = "auto",
    valid: NDArray[np.uint8] | None = None,
) -> Detection:
    """Find the marks of a gel, whatever their size, shape and arrangement.

    Differences of Gaussians over a range of scales give families of spots. The strongest one (many, alike,
    evenly spaced) wins, without weak and lonely spots, ones between the others and ones cut by the border.

    Parameters
    ----------
    image : (H, W, 3) uint8 BGR or (H, W) uint8, grey levels.
    dot_radius : of a (whole) mark, px, 1 to a quarter of the shorter side; None finds it, but then wants at
        least four marks in an even arrangement, lest dust passes for them.
    polarity : "dark" or "bright" against the gel; "auto" takes the stronger family.
    valid : (H, W) uint8, not 0 where there is gel; no mark is looked for where most of what lies around is
        none. None: everywhere.

    Returns
    -------
    Detection : centres ordered by rows, top to bottom, left to right. The search in float32 decides which
        they are; the centres are float64, and those of a search in float64 would be the same to 1e-3 px.

    Raises
    ------
    NoMarkersError : nothing looks like a family of marks.
    ValueError : the image or a parameter is not of that kind.

    References
    ----------
    Lindeberg, "Feature detection with automatic scale selection", IJCV 30 (1998); Lowe, "Distinctive image
    features from scale-invariant keypoints", IJCV 60 (2004), for the difference of Gaussians.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> found = detect_markers(open_scene("press?frames=2").frame(0))
    >>> found.polarity, found.centers.shape[1]
    ('dark', 2)
    """
    gray, shortest = to_gray(image).astype(np.float32), min(image.shape[:2])
    _require_options(dot_radius, polarity, valid, gray.shape)
    if shortest < 8:
        raise NoMarkersError(_NO_MARKERS)
    best = _best_family(gray, valid, _sigmas(dot_radius, shortest), polarity)
    if best is None or (dot_radius is None and best.score < LEAST_SCORE):
        raise NoMarkersError(_NO_MARKERS + ("" if best is None else _FEW_MARKERS))
    radius = best.sigma * RADIUS_PER_SIGMA
    centers = refine_centers(gray if best.polarity == "dark" else 255 - gray, best.peaks, radius)
    centers = centers[_reading_order(centers, radius)]
    distances = _nearest(centers, 1)[0]
    pitch = float(np.median(distances[:, 0])) if len(centers) > 1 else LONE_PITCH * radius
    return Detection(centers, radius, best.polarity, pitch, neighbour_graph(centers, LONGEST_LINK * pitch))


def _require_options(
    dot_radius: float | None, polarity: str, valid: NDArray[np.uint8] | None, shape: tuple[int, ...]
) -> None:
    """Raises ValueError for options of `detect_markers` that are not of their kind."""
    largest = max(1.0, min(shape) / 4)
    if dot_radius is not None and not 1.0 <= dot_radius <= largest:
        raise ValueError(f"required dot_radius 1 to {largest:g} px, got {dot_radius:g}")
    if polarity not in ("auto", "dark", "bright"):
        raise ValueError(f"required polarity to be 'auto', 'dark' or 'bright', got {polarity!r}")
    if valid is not None and (valid.shape != shape or valid.dtype != np.uint8):
        raise ValueError(f"required valid to be {shape} uint8, got shape {valid.shape}, dtype {valid.dtype}")


class _Family(NamedTuple):
    """Spots that look like marks of one gel: how much so, at which scale and polarity, and where."""

    score: float
    sigma: float
    polarity: Literal["dark", "bright"]
    peaks: FloatArray


def _best_family(
    gray: NDArray[np.float32], valid: NDArray[np.uint8] | None, sigmas: Sequence[float], polarity: Polarity
) -> _Family | None:
    """The family of the highest score of all scales."""
    polarities: Sequence[Literal["dark", "bright"]] = (
        ("dark", "bright") if polarity == "auto" else (polarity,)
    )
    best: _Family | None = None
    for sigma in sigmas:
        for family in _families(gray, valid, sigma, polarities):
            if best is None or family.score > best.score:
                best = family
    return best


def _families(
    gray: NDArray[np.float32],
    valid: NDArray[np.uint8] | None,
    sigma: float,
    polarities: Sequence[Literal["dark", "bright"]],
) -> Iterator[_Family]:
    """The family of each polarity at one scale, if there is one."""
    factor = 1
    while sigma >= factor * FULL_SIZE_SIGMA:
        factor *= 2
    fine = sigma / factor
    narrow, wide = _blurred(_shrunk(gray, factor), fine)
    for sign in polarities:
        peaks, strength = _peaks(wide - narrow if sign == "dark" else narrow - wide, fine)
        spots = _surrounded(narrow if sign == "dark" else -narrow, peaks, fine * RADIUS_PER_SIGMA)
        peaks, strength = peaks[spots] * factor + (factor - 1) / 2, strength[spots]
        if valid is not None:
            on_gel = _on_gel(valid, peaks, sigma * RADIUS_PER_SIGMA)
            peaks, strength = peaks[on_gel], strength[on_gel]
        kept = _members(peaks, strength, gray.shape, sigma * RADIUS_PER_SIGMA)
        if len(kept):
            yield _Family(_score(peaks[kept], strength[kept]), sigma, sign, peaks[kept])


def refine_centers(gray: NDArray[np.float32], centers: FloatArray, radius: float) -> FloatArray:
    """Centroid of what is darker than its surroundings, in a window that follows it.

    The surroundings are a plane fitted to a ring around the mark, so a slope of the light does not pull.

    Parameters
    ----------
    gray : (H, W) float32, grey levels; marks are dark.
    centers : (N, 2) float64, starting points, px, right to about a radius.
    radius : of a mark, px.

    Returns
    -------
    centers : (N, 2) float64, px; where there is nothing dark, the starting point. Whole grey levels are
        exact in float32, and everything after is float64.

    Examples
    --------
    >>> gray = np.full((30, 30), 200, np.float32)
    >>> gray[12:17, 10:15] = 50
    >>> refine_centers(gray, np.array([[11.0, 15.0]]), 2.5).round(3)
    array([[12., 14.]])
    """
    inner, outer = SURROUNDINGS[0] * radius, SURROUNDINGS[1] * radius + 1.5
    reach = int(np.ceil(outer))
    axis = np.arange(-reach, reach + 1)
    grid_x, grid_y = (part.ravel().astype(np.float64) for part in np.meshgrid(axis, axis))
    padded = cv2.copyMakeBorder(gray, reach, reach, reach, reach, cv2.BORDER_REPLICATE).astype(np.float64)
    height, width = gray.shape
    result = np.array(centers, np.float64)
    limits = np.array([width - 1, height - 1])
    for _ in range(CENTROID_ROUNDS):
        corner = np.clip(np.rint(result).astype(np.int64), 0, limits)
        patches = padded[
            corner[:, 1, None] + (grid_y + reach).astype(np.int64),
            corner[:, 0, None] + (grid_x + reach).astype(np.int64),
        ]
        x = grid_x + corner[:, :1] - result[:, :1]
        y = grid_y + corner[:, 1:] - result[:, 1:]
        distance = np.hypot(x, y)
        ring = np.clip(distance - inner, 0, 1) * np.clip(outer - distance, 0, 1)
        basis = np.stack([np.ones_like(x), x, y], axis=1)
        weighted = basis * ring[:, None]
        normal = weighted @ basis.transpose(0, 2, 1)
        plane = np.linalg.solve(normal, weighted @ patches[:, :, None])
        darkness = np.maximum((basis.transpose(0, 2, 1) @ plane)[:, :, 0] - patches, 0)
        darkness *= np.clip(CENTROID_WINDOW * radius + 0.5 - distance, 0, 1)
        total = darkness.sum(axis=1)
        good = total > 1e-3
        move = np.zeros_like(result)
        move[good, 0] = (darkness * x).sum(axis=1)[good] / total[good]
        move[good, 1] = (darkness * y).sum(axis=1)[good] / total[good]
        result += np.clip(move, -radius, radius)
        if np.abs(move).max(initial=0) < CENTROID_CONVERGED:
            break
    return result


def neighbour_graph(centers: FloatArray, longest: float) -> NDArray[np.int64]:
    """Which marks are neighbours: a beta-skeleton, free of diagonals on square grids.

    Two marks are neighbours unless a third lies (nearly) inside the circle whose diameter they are.

    Parameters
    ----------
    centers : (N, 2) float64, px. longest : neighbours are no farther apart than this, px.

    Returns
    -------
    edges : (E, 2) int64, each pair once, smaller index first, sorted. Marks in one place are no neighbours.
        Distances are float32 relative to the mean of all marks, so that an offset costs nothing: 1e-2 px for
        marks spread over 1e4 px.

    References
    ----------
    Gabriel and Sokal, "A new statistical approach to geographic variation analysis", Systematic Zoology 18
    (1969); Kirkpatrick and Radke, "A framework for computational morphology" (1985).

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
    >>> neighbour_graph(square, 20.0).tolist()
    [[0, 1], [0, 2], [1, 3], [2, 3]]
    """
    count = len(centers)
    if count < 2:
        return np.zeros((0, 2), np.int64)
    distances, near = _nearest(centers, min(GRAPH_CANDIDATES, count - 1))
    squared = distances**2
    between = ((centers[near][:, :, None] - centers[near][:, None, :]) ** 2).sum(axis=3)
    blocked = squared[:, None, :] + between < BLOCKING * squared[:, :, None]
    blocked &= ~np.eye(near.shape[1], dtype=bool)
    # Of marks in one place, the nearest may be the mark itself.
    keep = ~blocked.any(axis=2) & (distances <= longest) & (distances > 0)
    first = np.repeat(np.arange(count), keep.sum(axis=1))
    pairs = np.sort(np.column_stack([first, near[keep]]), axis=1)
    return np.unique(pairs, axis=0).astype(np.int64)


def _sigmas(dot_radius: float | None, shortest: int) -> list[float]:
    if dot_radius is not None:
        return [dot_radius / RADIUS_PER_SIGMA]
    largest = max(SIGMA_STEP, shortest * LARGEST_MARK)
    count = 1 + int(np.floor(np.log(largest / LEAST_SIGMA) / np.log(SIGMA_STEP)))
    return [LEAST_SIGMA * SIGMA_STEP**index for index in range(count)]


def _shrunk(gray: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Means over blocks of factor x factor pixels; what is left at the right and at the bottom is cut off."""
    if factor == 1:
        return gray
    height, width = gray.shape[0] // factor, gray.shape[1] // factor
    cut = gray[: height * factor, : width * factor]
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _blurred(gray: NDArray[np.float32], sigma: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The image at a scale and at the next coarser one; their difference answers to spots of the scale."""
    narrow = cv2.GaussianBlur(gray, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    step = sigma * float(np.sqrt(SCALE_RATIO**2 - 1.0))
    wide = cv2.GaussianBlur(narrow, (0, 0), step, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(narrow, np.float32), np.asarray(wide, np.float32)


def _surrounded(smooth: NDArray[np.float32], peaks: FloatArray, radius: float) -> NDArray[np.int64]:
    """Indices of the peaks that are darker than what lies around them in (almost) every direction.

    Edges and lines also answer to a difference of Gaussians, but are as dark along themselves.
    """
    if len(peaks) == 0:
        return np.zeros(0, np.int64)
    angles = np.arange(RING_POINTS) * (2 * np.pi / RING_POINTS)
    ring = peaks[:, None] + RING * radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    limits = np.array([smooth.shape[1] - 1, smooth.shape[0] - 1])
    column, row = np.clip(np.rint(ring).astype(np.int64), 0, limits).transpose(2, 0, 1)
    own_column, own_row = np.clip(np.rint(peaks).astype(np.int64), 0, limits).T
    above = np.sort(smooth[row, column] - smooth[own_row, own_column][:, None], axis=1)
    return np.flatnonzero(above[:, 1] > RING_CONTRAST * above[:, RING_POINTS // 2])


def _on_gel(valid: NDArray[np.uint8], peaks: FloatArray, radius: float) -> NDArray[np.bool_]:
    """Which peaks have gel in at least half of the square around them."""
    side = 2 * round(RING * radius) + 1
    share = cv2.boxFilter((valid > 0).astype(np.float32), -1, (side, side), borderType=cv2.BORDER_REPLICATE)
    limits = np.array([valid.shape[1] - 1, valid.shape[0] - 1])
    column, row = np.clip(np.rint(peaks).astype(np.int64), 0, limits).T
    return np.asarray(share[row, column] >= 0.5)


def _peaks(response: NDArray[np.float32], sigma: float) -> tuple[FloatArray, FloatArray]:
    """Local maxima, refined to sub-pixels by a parabola along each axis: positions (N, 2), strengths (N,)."""
    # Marks do not overlap: peaks that are nearer to each other are the border of one spot of a larger scale.
    size = 2 * max(1, round(OVERLAP * RADIUS_PER_SIGMA * sigma)) + 1
    highest = cv2.dilate(response, np.ones((size, size), np.uint8))
    rows, columns = np.nonzero((response >= highest) & (response > LEAST_RESPONSE))
    inside = (rows > 0) & (columns > 0) & (rows < response.shape[0] - 1) & (columns < response.shape[1] - 1)
    rows, columns = rows[inside], columns[inside]
    strongest = np.argsort(-response[rows, columns], kind="stable")[:MOST_PEAKS]
    rows, columns = rows[strongest], columns[strongest]
    value = response[rows, columns].astype(np.float64)
    points = np.column_stack([columns, rows]).astype(np.float64)
    for axis, (step_y, step_x) in enumerate(((0, 1), (1, 0))):
        before = response[rows - step_y, columns - step_x]
        after = response[rows + step_y, columns + step_x]
        bend = before + after - 2 * value
        points[:, axis] += np.where(bend < -1e-6, 0.5 * (before - after) / np.minimum(bend, -1e-6), 0.0)
    return points, value


def _members(
    peaks: FloatArray, strength: FloatArray, shape: tuple[int, ...], radius: float
) -> NDArray[np.int64]:
    """Indices of the peaks that belong to one family of marks."""
    if len(peaks) == 0:
        return np.zeros(0, np.int64)
    height, width = shape
    margin = BORDER_MARGIN * radius
    inside = (peaks[:, 0] >= margin) & (peaks[:, 0] <= width - 1 - margin)
    inside &= (peaks[:, 1] >= margin) & (peaks[:, 1] <= height - 1 - margin)
    kept = np.flatnonzero(inside)
    order = kept[np.argsort(-strength[kept], kind="stable")]
    if len(order) == 0:
        return order
    # Strengths of marks are alike, those of dirt and grain are a tail: cut at a part of the typical one,
    # which is found from the top down so that the tail's length does not matter.
    ranked = strength[order]
    typical = ranked[0]
    for _ in range(8):
        members = ranked[ranked > FAMILY_STRENGTH * typical]
        typical = float(np.median(members))
    kept = order[(ranked > FAMILY_STRENGTH * typical) & (ranked > LEAST_STRENGTH)]
    if len(kept) < 3:
        return np.asarray(kept, np.int64)
    for _ in range(3):
        distances, near = _nearest(peaks[kept], min(4, len(kept) - 1))
        pitch = float(np.median(distances[:, 0]))
        between = (distances[:, 0] < BETWEEN * pitch) & (strength[kept] < strength[kept][near[:, 0]])
        lonely = distances[:, min(1, distances.shape[1] - 1)] > LONELY * pitch
        if not (between | lonely).any():
            break
        kept = kept[~(between | lonely)]
        if len(kept) < 3:
            break
    # Evenly spaced spots that overlap are the ridges of a pattern.
    if len(kept) > 1 and float(np.median(_nearest(peaks[kept], 1)[0])) < OVERLAP * radius:
        return np.zeros(0, np.int64)
    return np.asarray(kept, np.int64)


def _score(peaks: FloatArray, strength: FloatArray) -> float:
    """How much a family looks like marks: strong, many, alike, evenly spaced."""
    count = len(peaks)
    typical = float(np.median(strength))
    even = 0.5
    if count >= 4:
        nearest = _nearest(peaks, 1)[0][:, 0]
        pitch = float(np.median(nearest))
        even = 1.0 / (1.0 + 4.0 * float(np.mean(np.minimum(np.abs(nearest / pitch - 1.0), 1.0))))
    return typical * even**2 * float(np.sqrt(min(count, ENOUGH_MARKS)))


def _nearest(points: FloatArray, count: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Distances to and indices of the `count` nearest other points, nearest first: two (N, count) arrays."""
    count = min(count, len(points) - 1)
    if count < 1:
        return np.zeros((len(points), 0)), np.zeros((len(points), 0), np.int64)
    flat = np.ascontiguousarray(points - points.mean(axis=0), np.float32)
    distances, near = cv2.batchDistance(flat, flat, cv2.CV_32F, None, None, cv2.NORM_L2, count + 1)
    # The nearest is the point itself.
    return np.asarray(distances[:, 1:], np.float64), np.asarray(near[:, 1:], np.int64)


def _reading_order(centers: FloatArray, radius: float) -> NDArray[np.int64]:
    """Order by rows: a new row begins where the next centre lies a radius lower than the one before."""
    by_height = np.argsort(centers[:, 1], kind="stable")
    rows = np.concatenate([[0], np.cumsum(np.diff(centers[by_height, 1]) > radius)])
    return by_height[np.lexsort((centers[by_height, 0], rows))]
