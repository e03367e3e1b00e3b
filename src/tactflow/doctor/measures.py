"""What can be told of a sensor's pictures without knowing the truth: pure functions on arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers import Detection
from tactflow.vision.markers.lattice import corners

Image = NDArray[np.uint8]
Gray = NDArray[np.float32]

BRIGHTER: Final = 0.95
"""Share of the gel that is darker than its brighter parts: a dark gel with bright pins is well exposed."""
TILE: Final = 16
"""Side of the tiles that noise is measured in, px. Chosen by hand."""
CALM: Final = 25.0
"""Percentile of the tiles that is taken for the noise: what moves or is textured fills the others."""
NOISE_PAIRS: Final = 8
"""Pairs of frames that noise is measured in. Chosen by hand: each has hundreds of tiles."""
BLOCK: Final = 8
"""Side of the blocks of JPEG, px."""
SATURATED: Final = 254
"""Grey level from which on a channel is clipped."""
BLACK: Final = 4
"""Grey level up to which a pixel shows no gel, but a black surround."""
SCALES: Final = ((1.0, 2.0), (2.0, 4.0))
"""Standard deviations of pairs of blurs under which edges are compared, px. Chosen by hand."""
EDGE_SHARE: Final = 98.0
"""Percentile of the slope from which on a pixel belongs to an edge. Chosen by hand."""
LEAST_SLOPE: Final = 2.0
"""Slope of an edge under a blur of 1 px, grey levels a px. Chosen by hand: well above noise of 2 grey levels,
of which that blur leaves a slope of 0.6."""
LEAST_EDGES: Final = 30
"""Edge pixels from which on a blur is told. Chosen by hand."""
SHARPEST: Final = 25.0
"""Percentile of the edges' blurs that is taken for the lens's: soft shades are edges, too. Chosen by hand."""
STRIPS: Final = 4
"""Strips in which bands are looked for. Chosen by hand."""
MOST_WAVES: Final = 24
"""Bands across a picture, at most. Chosen by hand: mains light at 120 Hz on a shutter of 100 ms has 12."""
DIM: Final = 25
"""Grey level below which a change of the light is not looked for. Chosen by hand: noise would be 8 %."""
STEPS: Final = (2.0, 100.0, 0.25)
"""Steps of JPEG that are tried: from, to, and the distance of two, grey levels."""
LEAST_WAVES: Final = 100
"""Coefficients from which on a step is told. Chosen by hand."""
BEAT: Final = 0.5
"""How well coefficients keep the beat of a step, to be its multiples: 0 at random, 1 at best. Found by hand:
0.2 at most without JPEG, 0.8 and more with it."""
TABLE: Final = 11.5
"""Step of the coarsest waves at quality 50: the mean of 11 and 12, ITU-T T.81, table K.1."""
REGULAR: Final = 0.7
"""Share of parallelograms that close from which on a grid is regular; 0.8 and more in grids. By hand."""
WINDOW: Final = 31
"""Side of the window in which a point is followed, px. Chosen by hand."""
RETURN: Final = 0.3
"""How near a point must come back to where it started, px. Chosen by hand."""
SMOOTHING: Final = 1.5
"""Standard deviation of the blur under which points are followed, px. Chosen by hand, against noise."""
CORNERS: Final = (0.05, 8.0)
"""Least quality of a point relative to the best one, and least distance of two, px. Chosen by hand."""
MAD_TO_SIGMA: Final = 1.4826
"""Standard deviation of a normal variable in units of its median absolute deviation."""


def temporal_noise(first: Image, second: Image) -> float:
    """Standard deviation of one frame's noise, grey levels, from two frames in a row.

    first, second : (H, W, 3) uint8. What moves fills less than three quarters of the picture, or counts.

    >>> rng = np.random.default_rng(0)
    >>> one, other = (np.uint8(rng.normal(100, 3, (160, 160, 3)).round()) for _ in range(2))
    >>> round(temporal_noise(one, other))
    3
    """
    difference = first.astype(np.float32) - second
    return float(_calm_deviation(difference) / np.sqrt(2.0))


def spatial_noise(image: Image) -> float:
    """Standard deviation of a frame's noise, grey levels, from that frame alone; texture adds to it.

    image : (H, W, 3) uint8.

    References
    ----------
    J. Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding 64 (1996): the
    difference of two Laplacians, which is blind to slopes and edges along the axes.

    >>> rng = np.random.default_rng(0)
    >>> round(spatial_noise(np.uint8(rng.normal(100, 3, (160, 160, 3)).round())))
    3
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return _calm_deviation(np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel), np.float32)) / 6.0


class Pair(NamedTuple):
    """Two frames in a row.

    number : of the first. image : (H, W, 3) uint8. after : the next frame, None at the end.
    """

    number: int
    image: Image
    after: Image | None


def noise_of(pairs: Sequence[Pair]) -> float:
    """Standard deviation of the noise of a frame, grey levels: the smaller of what is seen within frames and
    between them, since each has something else on top, texture or motion."""
    some = pairs[:: max(1, len(pairs) // NOISE_PAIRS)]
    own = [spatial_noise(pair.image) for pair in some]
    apart = [temporal_noise(pair.image, pair.after) for pair in some if pair.after is not None]
    return min(float(np.median(values)) for values in (own, apart) if values)


def _calm_deviation(values: NDArray[np.float32]) -> float:
    """Deviation within the calmer tiles of (H, W, 3) values, RMS over the channels."""
    height, width = (side - side % TILE for side in values.shape[:2])
    if not height or not width:
        return float(values.std())
    tiles = values[:height, :width].reshape(height // TILE, TILE, width // TILE, TILE, -1)
    variance = tiles.var(axis=(1, 3)).mean(axis=-1)
    return float(np.sqrt(np.percentile(variance, CALM)))


class Exposure(NamedTuple):
    """level : of the brighter parts of the gel, in its brightest channel, grey levels. clipped : share of the
    gel with a channel at its upper end."""

    level: float
    clipped: float


def exposure(image: Image) -> Exposure:
    """How a frame (H, W, 3) uint8 is exposed; black surroundings do not count.

    >>> exposure(np.full((4, 4, 3), 255, np.uint8))
    Exposure(level=255.0, clipped=1.0)
    """
    blue, green, red = cv2.split(image)
    levels = np.bincount(cv2.max(cv2.max(blue, green), red).ravel(), minlength=256)
    levels[: BLACK + 1] = 0
    gel = int(levels.sum())
    if not gel:
        return Exposure(0.0, 0.0)
    level = int(np.searchsorted(np.cumsum(levels), BRIGHTER * gel))
    return Exposure(float(level), float(levels[SATURATED:].sum() / gel))


def blur(gray: Gray) -> float | None:
    """Standard deviation of the point spread at the sharper edges of a picture, px; None without edges.

    gray : (H, W) float32, best a mean over frames. The slope of a step that is blurred by s and by a known
    blur a falls as 1 / sqrt(s^2 + a^2); two known blurs give s.

    References
    ----------
    S. Zhuo and T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44 (2011).

    >>> step = np.repeat([[50.0] * 40 + [150.0] * 40], 80, axis=0).astype(np.float32)
    >>> round(blur(np.asarray(cv2.GaussianBlur(step, (0, 0), 3.0), np.float32)))
    3
    """
    found = [value for scales in SCALES if (value := _blur_between(gray, *scales)) is not None]
    # Where the blur is wider than a dot, the coarser pair tells more of it.
    return max(found, default=None)


def _blur_between(gray: Gray, first: float, second: float) -> float | None:
    """The same, from the slopes under two blurs, px."""
    fine, coarse = (
        _slope(np.asarray(cv2.GaussianBlur(gray, (0, 0), s), np.float32)) for s in (first, second)
    )
    # The crest of an edge: no neighbour is steeper.
    crest = (fine >= cv2.dilate(fine, np.ones((3, 3), np.uint8))) & (fine >= LEAST_SLOPE / first)
    crest &= fine >= np.percentile(fine, EDGE_SHARE)
    if np.count_nonzero(crest) < LEAST_EDGES:
        return None
    ratio = np.square(fine[crest] / np.maximum(coarse[crest], 1e-6))
    squared = (second**2 - ratio * first**2) / np.maximum(ratio - 1.0, 1e-3)
    return float(np.sqrt(np.percentile(np.maximum(squared, 0.0), SHARPEST)))


def _slope(gray: Gray) -> Gray:
    x = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    y = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return np.asarray(cv2.magnitude(x, y), np.float32)


def jpeg_step(gray: Gray) -> float | None:
    """Step to which JPEG has rounded the coarsest wave of its blocks, grey levels; None if it has not.

    gray : (H, W) float32, whole grey levels of one frame. The blocks may begin at any pixel: a picture may
    have been cut. A standard table of quality 50 has a step of 11, of quality 90 one of 2.

    References
    ----------
    Z. Fan and R. L. de Queiroz, "Identification of bitmap compression history: JPEG detection and quantizer
    estimation", IEEE Trans. Image Processing 12 (2003): a block's coefficients are multiples of the step.
    """
    rows, columns = (_phase(side) for side in (gray.T, gray))
    waves = _coefficients(gray, rows, columns)
    found = None
    for step in np.arange(*STEPS):
        telling = waves[np.abs(waves) > step / 2]
        if len(telling) < LEAST_WAVES:
            break
        # How well the coefficients keep the beat of the step: 1 for exact multiples, 0 at random.
        if np.cos(2 * np.pi * telling / step).mean() > BEAT:
            found = float(step)
    return found


def jpeg_quality(step: float) -> float:
    """Quality, 1 to 100, at which the usual tables have this step in grey levels.

    >>> jpeg_quality(11.5), jpeg_quality(23.0), jpeg_quality(2.3)
    (50.0, 25.0, 90.0)
    """
    share = step / TABLE
    return 50.0 / share if share > 1 else 100.0 - 50.0 * share


def _phase(gray: Gray) -> int:
    """Column, 0 to 7, at which blocks begin: there the steps are largest."""
    step = np.abs(np.diff(gray, axis=1))
    excess = (step[:, 1:-1] - (step[:, :-2] + step[:, 2:]) / 2).mean(axis=0)
    excess = excess[: len(excess) - len(excess) % BLOCK].reshape(-1, BLOCK)
    return int(np.median(excess, axis=0).argmax() + 2) % BLOCK if len(excess) else 0


def _coefficients(gray: Gray, row: int, column: int) -> NDArray[np.float32]:
    """The coefficients of the half wave across and of that down of each block, (N,)."""
    cut = gray[row:, column:]
    height, width = (side - side % BLOCK for side in cut.shape)
    blocks = cut[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    wave = np.cos((2 * np.arange(BLOCK) + 1) * np.pi / (2 * BLOCK)) / 2
    flat = np.full(BLOCK, np.sqrt(1 / BLOCK))
    across = np.einsum("iajb,a,b->ij", blocks, flat, wave)
    down = np.einsum("iajb,a,b->ij", blocks, wave, flat)
    return np.concatenate([across.ravel(), down.ravel()]).astype(np.float32)


def bands(frames: Sequence[Gray]) -> tuple[float, str]:
    """Amplitude of bands of light that roll over the frames, relative, and the axis they are stacked along.

    frames : (H, W) float32 each, at least three. Of each row, in several strips, the median of its ratio to
    the median frame is taken. A band crosses all strips alike, which no contact does: of a wave that part
    counts which all strips have in common.
    """
    middle = np.median(np.stack(frames), axis=0)
    ratios = [np.where(middle > DIM, frame / np.maximum(middle, DIM), 1.0) for frame in frames]
    rows = _common_wave(
        [[np.median(part, axis=1) for part in np.array_split(r, STRIPS, axis=1)] for r in ratios]
    )
    columns = _common_wave(
        [[np.median(part, axis=0) for part in np.array_split(r, STRIPS, axis=0)] for r in ratios]
    )
    return (rows, "rows") if rows >= columns else (columns, "columns")


def _common_wave(profiles: Sequence[Sequence[NDArray[np.float32]]]) -> float:
    """Amplitude of the strongest wave that all strips (frames, strips) of (N,) have in common."""
    stack = np.array(profiles)
    length = stack.shape[-1]
    place = np.linspace(-1.0, 1.0, length)
    basis = np.stack([np.ones(length), place, place**2], axis=1)
    rest = stack - (stack @ np.linalg.pinv(basis).T) @ basis.T
    spectrum = np.fft.rfft(rest * np.hanning(length))[..., 1 : MOST_WAVES + 1] * 4.0 / length
    mean = spectrum.mean(axis=1, keepdims=True)
    along = np.real(spectrum * np.conj(mean)) / np.maximum(np.abs(mean), 1e-12)
    return float(np.median(along.min(axis=1), axis=0).max(initial=0.0))


class Lattice(NamedTuple):
    """found : dots. closed : share of the parallelograms of neighbours that close. missing : share of
    the places of a regular grid, between the dots found, that are empty. contrast : median difference of a
    dot to its surroundings, grey levels."""

    found: int
    closed: float
    missing: float
    contrast: float


def lattice(found: Detection, gray: Gray) -> Lattice:
    """How regular the dots of a detection are, and how clear in the picture (H, W) they were found in."""
    expected = corners(found.centers, found.edges)
    closed = 0.0 if found.chosen is None else found.chosen.lattice
    missing = 0.0
    # Where the grid is irregular, nobody knows where a dot would be.
    if len(expected.points) and closed >= REGULAR:
        hull = cv2.convexHull(found.centers.astype(np.float32))
        inside = np.array(
            [cv2.pointPolygonTest(hull, (float(x), float(y)), False) > 0 for x, y in expected.points]
        )
        places = expected.points[inside]
        if len(places):
            away = np.hypot(*(places[:, None] - found.centers).transpose(2, 0, 1)).min(axis=1)
            gone = _distinct(places[away > found.pitch / 2], found.pitch / 2)
            missing = gone / (len(found.centers) + gone)
    return Lattice(len(found.centers), closed, missing, _contrast(found, gray))


def _distinct(points: NDArray[np.float64], reach: float) -> int:
    """How many places points (N, 2) show that lie closer together than `reach`."""
    kept: list[NDArray[np.float64]] = []
    for point in points:
        if all(np.hypot(*(point - other)) > reach for other in kept):
            kept.append(point)
    return len(kept)


def _contrast(found: Detection, gray: Gray) -> float:
    height, width = gray.shape
    x, y = np.clip(np.rint(found.centers).astype(int), 0, (width - 1, height - 1)).T
    around = cv2.blur(gray, (round(found.pitch) | 1,) * 2)
    return float(np.median(np.abs(around[y, x] - gray[y, x])))


def motion(reference: Image, now: Image, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Displacements (N, 2) px of points (N, 2) of a gray picture; NaN where they are not found again.

    reference, now : (H, W) uint8. Each point is followed to `now` and back.
    """
    if not len(points):
        return np.zeros((0, 2), np.float32)
    there, found = _followed(reference, now, points)
    back, again = _followed(now, reference, there)
    found &= again & (np.hypot(*(back - points).T) < RETURN)
    moved = there - points
    moved[~found] = np.nan
    return np.asarray(moved, np.float32)


def _followed(
    reference: Image, now: Image, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where points (N, 2) went, (N, 2), and whether they were found, (N,)."""
    size = (WINDOW, WINDOW)
    there, found, _ = cv2.calcOpticalFlowPyrLK(reference, now, points, points.copy(), winSize=size)
    return np.asarray(there, np.float32).reshape(-1, 2), np.asarray(found).ravel() == 1


def grey(image: Image) -> Gray:
    """(H, W, 3) uint8 BGR to (H, W) float32 of whole grey levels."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.float32)


def smooth(image: Image) -> Image:
    """(H, W, 3) uint8 BGR to (H, W) uint8, blurred, for `motion`."""
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (0, 0), SMOOTHING), np.uint8)


def points(image: Image, most: int) -> NDArray[np.float32]:
    """(N, 2) float32, px: at most so many points of a picture that can be followed."""
    found = cv2.goodFeaturesToTrack(smooth(image), most, *CORNERS)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found.reshape(-1, 2), np.float32)
