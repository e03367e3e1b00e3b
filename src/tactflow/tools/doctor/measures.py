"""Quality measures of a sensor's pictures without ground truth: pure functions on arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.recording.course import BLACK_GREY
from tactflow.vision.arrays import ColorImage
from tactflow.vision.markers import Detection
from tactflow.vision.markers.lattice import corners

Gray = NDArray[np.float32]

TILE_SIDE_PX: Final = 16
"""Side of the tiles for noise estimates, px: 256 samples each."""
MIN_LIT_GREY: Final = 25
"""Minimum grey level for relative changes of light: noise of 2 grey levels would be 8 %."""
STRIP_COUNT: Final = 4
"""Strips of a picture: bands of light cross all of them, a contact does not."""
MAX_BANDS: Final = 24
"""Maximum number of bands across a picture: 120 Hz light with a readout of 100 ms causes 12."""
MIN_CLOSED_SHARE: Final = 0.7
"""Minimum share of closing parallelograms in a regular grid, where it is 0.8 and more. Chosen by hand."""


class Pair(NamedTuple):
    """Two consecutive frames.

    Attributes
    ----------
    number : index of the first.
    image : (H, W, 3) uint8.
    after : the next frame, None at the end.
    """

    number: int
    image: ColorImage
    after: ColorImage | None


class Lattice(NamedTuple):
    """How regular and how distinct the dots of a gel are.

    Attributes
    ----------
    found : number of dots.
    closed : share of the parallelograms of neighbours that close.
    missing : share of empty positions in a regular grid.
    contrast : median difference between a dot and its surroundings, grey levels.
    """

    found: int
    closed: float
    missing: float
    contrast: float


def grey(image: ColorImage) -> Gray:
    """(H, W, 3) uint8 BGR to (H, W) float32 of whole grey levels."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.float32)


def temporal_noise(first: ColorImage, second: ColorImage) -> float:
    """Standard deviation of the noise of a frame, grey levels, from two consecutive frames.

    first, second : (H, W, 3) uint8. Robust to motion in up to three quarters of the picture.

    >>> rng = np.random.default_rng(0)
    >>> first, second = (np.uint8(rng.normal(100, 3, (160, 160, 3)).round()) for _ in range(2))
    >>> round(temporal_noise(first, second))
    3
    """
    return _calm_deviation(first.astype(np.float32) - second) / 2**0.5


def spatial_noise(image: ColorImage) -> float:
    """Standard deviation of the noise of a single frame, grey levels; texture adds to it.

    image : (H, W, 3) uint8. The difference of two Laplacians cancels slopes and edges along the axes (J.
    Immerkaer, "Fast noise variance estimation", Computer Vision and Image Understanding 64, 1996).
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    return _calm_deviation(np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel), np.float32)) / 6.0


def noise_of(pairs: Sequence[Pair]) -> float:
    """Standard deviation of the noise, grey levels: the smaller of the spatial estimate, which includes
    texture, and the temporal one, which includes motion."""
    # Eight pairs have thousands of tiles.
    sample = pairs[:: max(1, len(pairs) // 8)]
    within = [spatial_noise(pair.image) for pair in sample]
    between = [temporal_noise(pair.image, pair.after) for pair in sample if pair.after is not None]
    return min(float(np.median(values)) for values in (within, between) if values)


def _calm_deviation(values: NDArray[np.float32]) -> float:
    """Standard deviation of (H, W, 3) values at the lower quartile of the tiles, without motion and
    texture."""
    height, width = (side - side % TILE_SIDE_PX for side in values.shape[:2])
    if not height or not width:
        return float(values.std())
    tiles = values[:height, :width].reshape(
        height // TILE_SIDE_PX, TILE_SIDE_PX, width // TILE_SIDE_PX, TILE_SIDE_PX, -1
    )
    variance = tiles.var(axis=(1, 3)).mean(axis=-1)
    return float(np.sqrt(np.percentile(variance, 25.0)))


def exposure(image: ColorImage) -> float:
    """Level of a frame (H, W, 3) uint8, without the black surround, grey levels.

    It is the 95th percentile of the gel's brightest channel, because a dark gel with bright pins is well
    exposed.

    >>> exposure(np.full((4, 4, 3), 255, np.uint8))
    255.0
    """
    brightest = image.max(axis=2)
    gel = brightest[brightest > BLACK_GREY]
    return float(np.percentile(gel, 95.0)) if gel.size else 0.0


def blur(gray: Gray) -> float | None:
    """Standard deviation of the point spread function at the sharper edges, px; None without edges.

    gray : (H, W) float32, preferably a median over frames. The slope of a step that is blurred by s and by a
    known blur a falls as 1 / sqrt(s^2 + a^2); two known blurs give s (S. Zhuo and T. Sim, "Defocus map
    estimation from a single image", Pattern Recognition 44, 2011).

    >>> step = np.repeat([[50.0] * 40 + [150.0] * 40], 80, axis=0).astype(np.float32)
    >>> round(blur(np.asarray(cv2.GaussianBlur(step, (0, 0), 3.0), np.float32)))
    3
    """
    # For blur wider than a dot, the coarser pair of scales is more sensitive.
    found = [_blur_between(gray, *scales) for scales in ((1.0, 2.0), (2.0, 4.0))]
    return max((value for value in found if value is not None), default=None)


def _blur_between(gray: Gray, first: float, second: float) -> float | None:
    """Blur from the slopes at two scales, px."""
    fine, coarse = (
        _slope(np.asarray(cv2.GaussianBlur(gray, (0, 0), sigma), np.float32)) for sigma in (first, second)
    )
    # Edge pixels are local maxima of the slope, among the steepest 2 % of the picture and well above noise,
    # which has a slope of 0.6 grey levels per px at a standard deviation of 2.
    crest = (fine >= cv2.dilate(fine, np.ones((3, 3), np.uint8))) & (fine >= 2.0 / first)
    crest &= fine >= np.percentile(fine, 98.0)
    if np.count_nonzero(crest) < 30:
        return None
    ratio = np.square(fine[crest] / np.maximum(coarse[crest], 1e-6))
    squared = (second**2 - ratio * first**2) / np.maximum(ratio - 1.0, 1e-3)
    # Only the sharper edges show the blur of the lens; shading is soft.
    return float(np.sqrt(np.percentile(np.maximum(squared, 0.0), 25.0)))


def _slope(gray: Gray) -> Gray:
    x = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    y = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    return np.asarray(cv2.magnitude(x, y), np.float32)


def bands(frames: Sequence[Gray]) -> tuple[float, str]:
    """Relative amplitude of bands of light that roll over the frames, and the axis along which they
    alternate.

    frames : (H, W) float32 each, at least three. Each frame is divided by the median frame; the medians over
    the rows of a strip are a profile of the light.
    """
    middle = np.median(np.stack(frames), axis=0)
    ratios = [
        np.where(middle > MIN_LIT_GREY, frame / np.maximum(middle, MIN_LIT_GREY), 1.0) for frame in frames
    ]
    amplitudes = {
        axis: _common_wave([_profiles(ratio if axis == "rows" else ratio.T) for ratio in ratios])
        for axis in ("rows", "columns")
    }
    axis = max(amplitudes, key=lambda name: amplitudes[name])
    return amplitudes[axis], axis


def _profiles(ratio: NDArray[Any]) -> list[NDArray[Any]]:
    return [np.median(strip, axis=1) for strip in np.array_split(ratio, STRIP_COUNT, axis=1)]


def _common_wave(profiles: Sequence[Sequence[NDArray[Any]]]) -> float:
    """Amplitude of the strongest wave common to all strips of the profiles (frames, strips, N)."""
    stack = np.array(profiles)
    length = stack.shape[-1]
    position = np.linspace(-1.0, 1.0, length)
    basis = np.stack([np.ones(length), position, position**2], axis=1)
    residual = stack - (stack @ np.linalg.pinv(basis).T) @ basis.T
    spectrum = np.fft.rfft(residual * np.hanning(length))[..., 1 : MAX_BANDS + 1] * 4.0 / length
    mean = spectrum.mean(axis=1, keepdims=True)
    along = np.real(spectrum * np.conj(mean)) / np.maximum(np.abs(mean), 1e-12)
    return float(np.median(along.min(axis=1), axis=0).max(initial=0.0))


def lattice(detection: Detection, gray: Gray) -> Lattice:
    """Regularity of the dots of a detection, and their contrast in the picture (H, W)."""
    height, width = gray.shape
    x, y = np.clip(np.rint(detection.centers).astype(int), 0, (width - 1, height - 1)).T
    around = cv2.blur(gray, (round(detection.pitch) | 1,) * 2)
    contrast = float(np.median(np.abs(around[y, x] - gray[y, x])))
    closed = 0.0 if detection.chosen is None else detection.chosen.lattice.closed_share
    # An irregular grid has no predictable positions.
    empty = len(_empty_positions(detection)) if closed >= MIN_CLOSED_SHARE else 0
    return Lattice(len(detection.centers), closed, empty / (len(detection.centers) + empty), contrast)


def _empty_positions(detection: Detection) -> list[NDArray[np.float64]]:
    """Positions (x, y), px, of a regular grid within the hull of the dots that have no dot."""
    hull = cv2.convexHull(detection.centers.astype(np.float32))
    empty: list[NDArray[np.float64]] = []
    for position in corners(detection.centers, detection.edges).points:
        occupied = np.array([*detection.centers, *empty])
        inside = cv2.pointPolygonTest(hull, (float(position[0]), float(position[1])), False) > 0
        if inside and np.hypot(*(occupied - position).T).min() > detection.pitch / 2:
            empty.append(position)
    return empty
