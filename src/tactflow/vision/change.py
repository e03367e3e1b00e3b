"""Has anything changed? A cheap look at a raw frame.

The frame is sampled at about 9 000 fixed places instead of being read whole: in each tile, those with the
steepest gradients (edges of dots, where motion shows most) and some spread evenly (where a contact
shows). The difference to the samples of the *anchor*, the last frame that was worked on, is tested tile by
tile against the sensor's own noise:

- motion: the projection on the gel's gradients, which is the least-squares estimate of a displacement
  (Lucas and Kanade, 1981) in units of its standard error, also of neighbouring tiles together;
- light: the mean;
- anything else: the sum of squares (chi-squared; Wilson and Hilferty's cube root turns it into a normal
  deviate, 1931).

All are compared with one bound, set from the share of still frames that may be taken for changed
(Bonferroni over all tests). Comparing with the anchor, not with the frame before, means that a slow drift
adds up until it is seen.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

_EDGES = 24
"""Samples of a tile on its steepest edges."""
_SPREAD = 8
"""Samples of a tile spread at random."""
_LINES = 150
"""Lines of the frame that are read, spread evenly."""
_WARM_UP = 6
"""Pairs of frames from which the noise is learned before any frame is called unchanged."""
_REACHES = (0, 1, 3)
"""Motion is tested in a tile and in its neighbourhoods up to so many tiles away: a contact drags its
surroundings along, and together they show a displacement that none of them shows alone."""
_QUANTISATION = 1 / 12
"""Variance of rounding to whole grey levels: noise below it cannot be seen."""
_FORGETTING = 0.05
"""Weight of a new frame in the running noise."""


class ChangeProbe:
    """Tells whether a frame differs from the anchor by more than noise.

    Computed in float32; the test values are those of float64 to 1e-5 of themselves.

    frame : (H, W, C) or (H, W) uint8, the first frame; it fixes the size and where to look.
    false_alarms : share of still frames that are called changed all the same, in (0, 0.5]. Each costs one
        frame's work; a smaller share lets larger changes pass unseen.
    tile : edge of a tile, px >= 8. Smaller tiles see smaller contacts and cost more.

    Raises
    ------
    ValueError : a frame is not an image of uint8, its size differs from the first one's, or a parameter is
        out of range.
    """

    def __init__(self, frame: NDArray[np.uint8], *, false_alarms: float = 1e-3, tile: int = 40) -> None:
        if not 0 < false_alarms <= 0.5:
            raise ValueError(f"required false_alarms in (0, 0.5], got {false_alarms}")
        if not (tile >= 8 and math.isfinite(tile)):
            raise ValueError(f"required a tile of at least 8 px, got {tile}")
        self._shape = _checked(frame).shape
        # Whole lines are read in one sweep; scattered reads of a frame that is not in the cache cost more.
        step = max(1, frame.shape[0] // _LINES)
        self._lines = slice(step // 2, None, step)
        self._places, gradients, self._grid = _choose_places(frame, self._lines, tile)
        strength = self._by_tile(np.square(gradients).sum(axis=1))
        self._certainty = [
            1 / np.sqrt(np.maximum(_neighbourhood(strength, reach), np.float32(1e-3))) for reach in _REACHES
        ]
        self._gradients = gradients
        _, tiles = self._places.shape
        tests = (2 + 2 * len(_REACHES)) * tiles + 2
        self.bound = -NormalDist().inv_cdf(false_alarms / (2 * tests))
        """What the strongest test value must exceed, in standard deviations."""
        self.strongest = float("inf")
        """The strongest test value of the last look, in standard deviations of noise; at least that, where
        it is above the bound: what has changed for sure is not tested further."""
        self._anchor: NDArray[np.float32] | None = None
        self._last: NDArray[np.float32] | None = None
        self._variance: NDArray[np.float32] | None = None
        self._pairs = 0

    @property
    def noise(self) -> float | None:
        """Standard deviation of the noise in the median tile, grey levels; None before it is known."""
        return None if self._variance is None else float(np.sqrt(np.median(self._variance)))

    def look(self, frame: NDArray[np.uint8]) -> bool:
        """Compare a frame with the anchor; one that has changed becomes the anchor.

        frame : same shape and dtype as the first.

        Returns
        -------
        True if the frame differs from the anchor by more than noise, or while the noise is not known yet.
        """
        if _checked(frame).shape != self._shape:
            raise ValueError(f"required a frame of shape {self._shape}, got {frame.shape}")
        lines = frame[self._lines].copy()
        samples = lines.reshape(-1).take(self._places).astype(np.float32)
        last, self._last = self._last, samples
        if last is not None:
            self._learn(samples - last)
        if self._anchor is None or self._pairs < _WARM_UP:
            self.strongest = float("inf")
        else:
            self.strongest = self._strongest(samples - self._anchor)
        changed = self.strongest > self.bound
        if changed:
            self._anchor = samples
        return changed

    def anchor_here(self) -> None:
        """Make the frame of the last look the anchor: it is worked on, whatever the look said."""
        self._anchor = self._last

    def _learn(self, step: NDArray[np.float32]) -> None:
        """Follow each tile's noise by the difference of frames in a row; a moving tile teaches nothing."""
        n, _ = step.shape
        seen = np.maximum(_sums(step * step) * np.float32(0.5 / n), np.float32(_QUANTISATION))
        self._pairs += 1
        if self._variance is None:
            self._variance = np.full_like(seen, np.median(seen))
            return
        # The mean of n squares scatters by sqrt(2 / n) of itself; six times that is motion, not noise.
        quiet = seen < self._variance * np.float32(1 + 6 * math.sqrt(2 / n))
        weight = np.float32(max(_FORGETTING, 1 / self._pairs))
        self._variance = np.where(quiet, self._variance + weight * (seen - self._variance), self._variance)
        if 2 * np.count_nonzero(quiet) < quiet.size:
            # Most of the frame moves, or the noise was learned from frames that were repeated: creep up.
            self._variance = np.where(quiet, self._variance, self._variance * np.float32(1.2))

    def _strongest(self, difference: NDArray[np.float32]) -> float:
        """The largest of the tests' values, each a standard normal deviate under noise alone."""
        assert self._variance is not None
        n, tiles = difference.shape
        scale = np.asarray(1 / np.sqrt(2 * self._variance), np.float32)
        light = _sums(difference) * scale
        squares = _sums(difference * difference) * (scale * scale)
        strongest = max(
            float(np.abs(light).max()) / math.sqrt(n),
            abs(float(light.sum())) / math.sqrt(n * tiles),
            _normal_deviate(float(squares.max()), n),
            _normal_deviate(float(squares.sum()), n * tiles),
        )
        return strongest if strongest > self.bound else max(strongest, self._motion(difference, scale))

    def _motion(self, difference: NDArray[np.float32], scale: NDArray[np.float32]) -> float:
        """The strongest displacement of a tile, or of the tiles of a neighbourhood together."""
        across, down = self._gradients
        pulls = self._by_tile(
            np.stack([_sums(difference * across) * scale, _sums(difference * down) * scale])
        )
        return max(
            cv2.norm(_neighbourhood(pulls, reach) * certainty, cv2.NORM_INF)
            for reach, certainty in zip(_REACHES, self._certainty, strict=True)
        )

    def _by_tile(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(2, tiles) as a picture of two channels, (rows, columns, 2)."""
        return np.ascontiguousarray(values.T.reshape(*self._grid, 2))


def _neighbourhood(picture: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Sum over each tile and its neighbours up to `reach` tiles away, (rows, columns, 2)."""
    if reach == 0:
        return picture
    size = (2 * reach + 1, 2 * reach + 1)
    return np.asarray(
        cv2.boxFilter(picture, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT), np.float32
    )


def _sums(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over the samples of each tile."""
    # A product with ones goes to BLAS, which is faster than a sum along the first axis.
    return np.ones(len(values), np.float32) @ values


def _normal_deviate(squares: float, degrees: int) -> float:
    """A chi-squared value as a standard normal deviate (Wilson and Hilferty)."""
    spread = 2 / (9 * degrees)
    return (math.cbrt(squares / degrees) - (1 - spread)) / math.sqrt(spread)


def _choose_places(
    frame: NDArray[np.uint8], lines: slice, tile: int
) -> tuple[NDArray[np.intp], NDArray[np.float32], tuple[int, int]]:
    """Where to sample.

    Returns flat indices (samples, tiles) into the frame's lines, the x and y gradients there (2, samples,
    tiles), and the rows and columns of tiles.
    """
    image = np.atleast_3d(frame).astype(np.float32)
    height, width, channels = image.shape
    smooth = np.atleast_3d(cv2.GaussianBlur(image, (5, 5), 0))
    across = np.atleast_3d(cv2.Sobel(smooth, cv2.CV_32F, 1, 0))[lines]
    down = np.atleast_3d(cv2.Sobel(smooth, cv2.CV_32F, 0, 1))[lines]
    steepness = np.hypot(across, down)
    best = steepness.argmax(axis=2)
    random = np.random.default_rng(0)
    chosen = []
    bands = max(1, min(len(steepness), round(height / tile)))
    across_tiles = max(1, round(width / tile))
    for rows in np.array_split(np.arange(len(steepness)), bands):
        for columns in np.array_split(np.arange(width), across_tiles):
            pixels = (rows[:, None] * width + columns).ravel()
            places = pixels * channels + best.ravel()[pixels]
            order = np.argsort(steepness.ravel()[places], kind="stable")[::-1]
            edges = np.resize(places[order[:_EDGES]], _EDGES)
            spread = random.choice(pixels, _SPREAD) * channels + random.integers(0, channels, _SPREAD)
            chosen.append(np.concatenate([edges, spread]))
    index = np.ascontiguousarray(np.array(chosen, dtype=np.intp).T)
    return index, np.stack([across.ravel()[index], down.ravel()[index]]), (bands, across_tiles)


def _checked(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or frame.size == 0:
        raise ValueError(f"required an image of uint8, got shape {frame.shape} {frame.dtype}")
    return frame
