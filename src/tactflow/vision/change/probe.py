"""Has anything changed? A cheap look at a raw frame.

A few lines of the frame are read, spread evenly, and compared with those of the *anchor*, the last frame
that was worked on: where the sum of squared differences exceeds what noise makes, the frame has changed and
nothing else is looked at. If it does not, the same is done with four times as many lines, and then sums over
tiles are tested:

- light: the sums of each channel and of all, which show a light that changes little but over an area;
- motion: the projection on the gel's gradients at its steepest edges, which is the least-squares estimate of
  a displacement (Lucas and Kanade, 1981);
- marks: the sum over those edges, which shows a dot that went further than its own size.

Each is tested in every tile and in windows of tiles (a contact shades and drags its surroundings along, and
together they show what none of them shows alone), in units of the noise that such sums have on this sensor.
That noise is learned from frames in a row, tile by tile. It is what neighbouring tiles do not share: light
that flickers is never taken for noise. All tests have one bound, set from the share of still frames that may
be taken for changed (Bonferroni over all tests).

Comparing with the anchor, not with the frame before, means that a slow drift adds up until it is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

_LINES = 40
"""Lines of the frame that are read, about; each costs a trip to memory."""
_GLANCE = 4
"""Every so manieth of these lines is read first; a contact that moves mostly shows in them."""
_EDGES = 24
"""Samples of a tile on its steepest edges."""
_WINDOWS = (1, 3, 7)
"""Widths and heights of the windows that are tested, tiles; also all tiles."""
_MEAN = 4
"""The anchor's sums are the mean of so many frames without a change, where there were any before it."""
_WARM_UP = 6
"""Pairs of frames from which the noise is learned before any frame is called unchanged."""
_CALM = 0.1
"""Share of still frames that are not calm."""
_EVERY = 16
"""Noise is learned in every so many frames: it changes slowly, and learning costs as much as a look."""
_FORGETTING = 0.05
"""Weight of a new pair of frames in the running noise."""
_QUIET = 9.0
"""A tile whose squared difference is so many times what noise makes (three standard deviations) moves."""
_LOWER = 0.9
"""Two frames that differ by less than this share of what noise is thought to make show that it makes less:
a sum over a hundred thousand pixels is known to a percent."""
_MEDIAN = 0.455
"""Median of the square of a standard normal deviate."""
_QUANTISATION = 1 / 12
"""Variance of rounding to whole grey levels: noise below it cannot be seen."""


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
        self._tiling = tiling = _Tiling(frame, tile)
        noise = self._noise = _Noise(tiling)
        self.bound, self._calm = (
            -NormalDist().inv_cdf(share / (2 * (noise.tests + 2)))
            for share in (false_alarms, max(false_alarms, _CALM))
        )
        """What the strongest test value must exceed, in standard deviations."""
        self.strongest = float("inf")
        """The strongest test value of the last look, in standard deviations of noise; at least that, where
        it is above the bound: what has changed for sure is not tested further."""
        self._anchor: _Sample | None = None
        self._last: _Sample | None = None
        # Mean of the sums over the first unchanged frames, and of how many; the same of the anchor.
        self._mean: NDArray[np.float32] | None = None
        self._anchor_mean: NDArray[np.float32] | None = None
        self._frames = self._anchor_frames = 0
        # The anchor, the last frame and this one.
        self._spare = [_Sample(tiling) for _ in range(3)]
        self._looks = 0

    @property
    def noise(self) -> float | None:
        """Standard deviation of a pixel's noise, grey levels, over the frame; None before it is known."""
        if self._noise.pairs == 0:
            return None
        return math.sqrt(max(self._noise.energy.mean / (2 * self._tiling.count), _QUANTISATION))

    @property
    def ready(self) -> bool:
        """Whether the noise is known, so that a look can tell what is unchanged."""
        return self._noise.pairs >= _WARM_UP

    @property
    def calm(self) -> bool:
        """Whether the last look saw nothing that nine of ten still frames do not show as well.

        A change that is too small to be told from noise for sure mostly is not calm either.
        """
        return self.strongest <= self._calm

    def look(self, frame: NDArray[np.uint8]) -> bool:
        """Compare a frame with the anchor; one that has changed becomes the anchor.

        frame : same shape and dtype as the first. It is kept while it is the anchor or the last one, and must
            not be written to meanwhile.

        Returns
        -------
        True if the frame differs from the anchor by more than noise, or while the noise is not known yet.
        """
        if _checked(frame).shape != self._shape:
            raise ValueError(f"required a frame of shape {self._shape}, got {frame.shape}")
        now, last = self._spare.pop(), self._last
        now.take(frame)
        noise = self._noise
        warming_up = not self.ready
        if last is not None and warming_up:
            noise.learn(now, last, self.bound)
        if self._anchor is None or not self.ready:
            self.strongest = float("inf")
        else:
            self.strongest = self._compare(now, self._anchor)
        changed = self.strongest > self.bound
        self._follow(now, changed)
        self._looks += 1
        if last is not None:
            if not warming_up and self._looks % _EVERY == 0:
                noise.learn(now, last, self.bound)
            if last is not self._anchor:
                self._spare.append(last)
        self._last = now
        if changed:
            self.anchor_here()
        return changed

    def anchor_here(self) -> None:
        """Make the frame of the last look the anchor: it is worked on, whatever the look said."""
        if self._anchor is not None and self._anchor is not self._last:
            self._spare.append(self._anchor)
        self._anchor = self._last
        self._anchor_mean, self._anchor_frames = self._mean, self._frames

    def _follow(self, now: _Sample, changed: bool) -> None:
        """Take a frame into the mean of the first ones that are unchanged."""
        if changed:
            self._mean, self._frames = None, 0
        elif self._frames < _MEAN:
            self._frames += 1
            sums = now.sums()
            mean = sums if self._mean is None else self._mean
            self._mean = mean + (sums - mean) / np.float32(self._frames)

    def _compare(self, now: _Sample, then: _Sample) -> float:
        """The largest of the tests' values, each a standard normal deviate under noise alone."""
        noise = self._noise
        strongest = noise.glance.excess(now.glance(then))
        if strongest <= self.bound:
            strongest = max(strongest, noise.energy.excess(now.energy(then)))
        if strongest > self.bound:
            return strongest
        mean, frames = self._anchor_mean, self._anchor_frames
        if mean is None:
            mean, frames = then.sums(), 1
        # Scaled for the noise of two frames; that of a mean is less.
        return max(strongest, noise.strongest(now.sums() - mean) * math.sqrt(2 / (1 + 1 / frames)))


class _Tiling:
    """Where to look: which lines, how they are cut into tiles, and where the steepest edges of a tile are.

    Samples are laid out (lines, channels, pixels), with zeros added so that all tiles are equally large; sums
    (rows of tiles, kinds, tiles in a row), the kinds being light of each channel and of all, marks, and
    motion in x and y.
    """

    def __init__(self, frame: NDArray[np.uint8], tile: int) -> None:
        frame = np.atleast_3d(frame)
        height, width, self.channels = frame.shape
        step = max(1, min(height // _LINES, tile))
        self.slice = slice(step // 2, None, step)
        lines = len(range(*self.slice.indices(height)))
        thick = max(1, min(lines, round(tile / step)))
        self.width = math.ceil(width / max(1, round(width / tile)))
        self.grid = rows, columns = math.ceil(lines / thick), math.ceil(width / self.width)
        self.size = rows * thick, self.channels, columns * self.width
        self.used = lines, width
        self.count = lines * width * self.channels
        self.lights = self.channels + (self.channels > 1)
        self.together = np.tile(np.eye(columns, dtype=np.float32), (self.channels, 1))
        self.glance = slice(step // 2, None, _GLANCE * step)
        self.glance_shape = frame[self.glance].shape
        self.collect = np.kron(np.eye(rows, dtype=np.float32), np.ones((1, thick), np.float32))
        self._choose_edges(frame)
        pixels = np.zeros(self.size, np.float32)
        pixels[:lines, :, :width] = 1
        unit = np.empty((rows, self.lights + 3, columns), np.float32)
        unit[:, : self.channels] = self._by_tile(pixels).sum(axis=-1)
        unit[:, self.lights - 1] = unit[:, : self.channels].sum(axis=1)
        at_edges = np.square(self.weights).sum(axis=1)
        unit[:, self.lights :] = at_edges.reshape(-1, rows, columns).swapaxes(0, 1)
        # A tile without any gradient shows no motion, and no noise of it either.
        self.unit = np.maximum(unit, np.float32(1e-3))
        """Variance of each sum for noise of variance 1 that is independent from pixel to pixel."""

    def _choose_edges(self, frame: NDArray[np.uint8]) -> None:
        """Flat indices (samples, tiles) of the steepest edges, and their weights in the sums there."""
        lines, width = self.used
        smooth = cv2.GaussianBlur(frame.astype(np.float32), (5, 5), 0)
        gradients = np.zeros((2, *self.size), np.float32)
        for gradient, (x, y) in zip(gradients, ((1, 0), (0, 1)), strict=True):
            slope = np.atleast_3d(cv2.Sobel(smooth, cv2.CV_32F, x, y))[self.slice]
            gradient[:lines, :, :width] = slope.transpose(0, 2, 1)
        steepness = np.full(self.size, -1, np.float32)
        steepness[:lines, :, :width] = np.hypot(*gradients)[:lines, :, :width]
        tiles = steepness.size // math.prod(self.grid)
        steepness = self._by_tile(steepness).swapaxes(1, 2).reshape(-1, tiles)
        index = self._by_tile(np.arange(steepness.size).reshape(self.size)).swapaxes(1, 2).reshape(-1, tiles)
        order = np.argsort(-steepness, axis=1, kind="stable")
        # A tile with too few pixels gives some of them several times.
        inside = np.count_nonzero(steepness >= 0, axis=1)[:, None]
        order = np.take_along_axis(order, np.arange(_EDGES) % np.minimum(inside, _EDGES), axis=1)
        places = np.take_along_axis(index, order, axis=1)
        self.places = np.ascontiguousarray(places.T, dtype=np.intp)
        slopes = gradients.reshape(2, -1)[:, self.places]
        self.weights = np.ascontiguousarray(np.concatenate([np.ones_like(slopes[:1]), slopes]))
        resting = np.zeros(self.size, np.uint8)
        resting[:lines, :, :width] = frame[self.slice].transpose(0, 2, 1)
        # Sums of differences to this are small numbers, which single precision adds without loss.
        self.resting = resting.reshape(-1)[self.places].astype(np.float32)
        self.ones = np.ones(_EDGES, np.float32)

    def _by_tile(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(lines, channels, pixels) as (rows, channels, columns, values of a tile)."""
        rows, columns = self.grid
        cut = values.reshape(rows, -1, self.channels, columns, self.width)
        return cut.transpose(0, 2, 3, 1, 4).reshape(rows, self.channels, columns, -1)


class _Sample:
    """The lines of one frame: few of them at once, all and the sums over tiles once they are asked for."""

    def __init__(self, tiling: _Tiling) -> None:
        self._tiling = tiling
        self._frame: NDArray[np.uint8] | None = None
        self._few = np.empty(tiling.glance_shape, np.uint8)
        self._planes = np.zeros(tiling.size, np.uint8)
        lines, width = tiling.used
        self._into = [self._planes[:lines, channel, :width] for channel in range(tiling.channels)]
        self._sums: NDArray[np.float32] | None = None

    def take(self, frame: NDArray[np.uint8]) -> None:
        """Begin with another frame."""
        self._sums = None
        self._frame = frame
        self._few[...] = frame[self._tiling.glance].reshape(self._few.shape)

    def planes(self) -> NDArray[np.uint8]:
        """All lines, (lines, channels, pixels)."""
        if self._frame is not None:
            lines = self._frame[self._tiling.slice]
            if len(self._into) == 1:
                self._into[0][...] = lines.reshape(self._into[0].shape)
            else:
                cv2.split(lines, self._into)
            self._frame = None
        return self._planes

    def glance(self, other: _Sample) -> float:
        """Sum of squared differences over a few lines."""
        return cv2.norm(self._few, other._few, cv2.NORM_L2SQR)

    def energy(self, other: _Sample) -> float:
        """Sum of squared differences over all lines."""
        return cv2.norm(self.planes(), other.planes(), cv2.NORM_L2SQR)

    def sums(self) -> NDArray[np.float32]:
        """Sums over tiles, (rows, kinds, columns)."""
        if self._sums is None:
            tiling = self._tiling
            rows, columns = tiling.grid
            channels = tiling.channels
            planes = self.planes()
            sums = np.empty(tiling.unit.shape, np.float32)
            cells = cv2.reduce(planes.reshape(-1, tiling.width), 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S)
            light = tiling.collect @ cells.reshape(-1, channels * columns).astype(np.float32)
            sums[:, :channels] = light.reshape(rows, channels, columns)
            if channels > 1:
                sums[:, channels] = light @ tiling.together
            edges = planes.reshape(-1).take(tiling.places).astype(np.float32) - tiling.resting
            # A product with ones goes to BLAS, which is faster than a sum along an axis.
            at_edges = tiling.ones @ (edges * tiling.weights)
            sums[:, tiling.lights :] = at_edges.reshape(-1, rows, columns).swapaxes(0, 1)
            self._sums = sums
        return self._sums


class _Energy:
    """What a sum of squared differences of two frames is under noise alone.

    count : how many differences are summed.
    """

    def __init__(self, count: int) -> None:
        self.mean = 0.0
        self._spread = 0.0
        self._count = count
        self.settle(1.0)

    def excess(self, energy: float) -> float:
        """How far a sum is above what noise makes, in its standard deviations."""
        return (energy - self.mean) * self._scale

    def learn(self, energy: float, weight: float) -> None:
        """Take in the sum for two frames that show the same."""
        beyond = energy - self.mean
        if beyond < (_LOWER - 1) * self.mean:
            self.mean, self._spread = energy, 0.0
        else:
            self.mean += weight * beyond
            # What the first one is away from nothing says nothing.
            self._spread += weight * (beyond * beyond * (weight < 1) - self._spread)

    def settle(self, doubt: float) -> None:
        """Make ready for `excess`. doubt : 1 / (number of sums that were learned)."""
        least = 2 * max(self.mean, 2 * _QUANTISATION * self._count) ** 2 / self._count
        self._scale = 1 / math.sqrt(max(self._spread, least) * (1 + _WARM_UP * doubt))


class _Noise:
    """What differences noise alone makes, learned from frames in a row.

    pairs : pairs of frames seen. energy, glance : of all lines, of a few. tests : how many values are
    compared with the bound in `strongest`.
    """

    def __init__(self, tiling: _Tiling) -> None:
        rows, columns = tiling.grid
        self._unit = tiling.unit
        self._light = tiling.lights
        self._windows = _windows(rows), np.ascontiguousarray(_windows(columns).T)
        self._near = _neighbours(rows), np.ascontiguousarray(_neighbours(columns).T)
        self.tests = len(self._windows[0]) * self._unit.shape[1] * self._windows[1].shape[1]
        self.pairs = 0
        self.energy = _Energy(tiling.count)
        self.glance = _Energy(math.prod(tiling.glance_shape))
        self._taught = 0
        # Of each sum, for one frame: as seen in its tile, and as used.
        self._seen = np.zeros_like(self._unit)
        self._variance = np.zeros_like(self._unit)
        self._settle()

    def strongest(self, difference: NDArray[np.float32]) -> float:
        """The largest deviation of a difference of sums in any window, in its standard deviations."""
        return cv2.norm(_product(self._windows, difference) * self._scale, cv2.NORM_INF)

    def learn(self, now: _Sample, last: _Sample, bound: float) -> None:
        """Take in two frames in a row; a tile that moves teaches nothing, nor does a repeated frame."""
        self.pairs += 1
        energy = now.energy(last)
        if energy == 0:
            return
        difference = now.sums() - last.sums()
        own = difference.copy()
        # What neighbours share is light that changes, and not noise.
        own[:, : self._light] -= self._smooth(difference)[:, : self._light]
        seen = np.square(own) * np.float32(0.5)
        self._taught += 1
        weight = max(_FORGETTING, 1 / self._taught)
        calm = self._taught <= _WARM_UP
        if self._taught == 1:
            level = np.median(seen / self._unit, axis=(0, 2), keepdims=True) / _MEDIAN
            self._seen = np.asarray(level * self._unit, np.float32)
        else:
            ratio = np.asarray(seen / self._variance, np.float32)
            typical = float(np.median(ratio))
            quiet = ratio < _QUIET
            self._seen += np.where(quiet, np.float32(weight) * (seen - self._seen), np.float32(0))
            # If most of the frame moves, the noise may have been learned too low, and if most of it is much
            # quieter than noise, it was learned while something moved: go there in steps.
            moves = typical > _QUIET
            if moves or typical < _MEDIAN / 4:
                self._seen *= np.float32(1.25 if moves else 0.5)
            calm = calm or moves or self.strongest(difference) <= bound
        if calm or energy < _LOWER * self.energy.mean:
            self.energy.learn(energy, weight)
            self.glance.learn(now.glance(last), weight)
        self._settle()

    def _settle(self) -> None:
        """From the variances of single tiles to the scales of all tests."""
        own = np.asarray(self._seen / self._unit, np.float32)
        # One tile's variance comes from few values, and its neighbours have nearly the same; only one that is
        # clearly louder is louder.
        level = np.maximum(np.maximum(self._smooth(own), own / 2), np.float32(_QUANTISATION))
        self._variance = np.asarray(level * self._unit, np.float32)
        # What is known from few pairs only is allowed to be wrong.
        doubt = 1 / max(self._taught, 1)
        windows = _product(self._windows, self._variance) * np.float32(2 * (1 + doubt))
        self._scale = np.asarray(1 / np.sqrt(windows), np.float32)
        for energy in (self.energy, self.glance):
            energy.settle(doubt)

    def _smooth(self, sums: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean over each tile and its neighbours, of each kind."""
        return _product(self._near, sums).reshape(sums.shape)


def _product(factors: Sequence[NDArray[np.float32]], sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums (rows, kinds, columns) times a matrix from the left and one from the right, (n * kinds, m)."""
    rows, _, columns = sums.shape
    left, right = factors
    return np.asarray((left @ sums.reshape(rows, -1)).reshape(-1, columns) @ right, np.float32)


def _windows(count: int) -> NDArray[np.float32]:
    """(n, count): ones where a window lies, for windows of all widths, each half overlapping the next."""
    found = []
    for width in {min(width, count) for width in (*_WINDOWS, count)}:
        last = count - width
        for start in {*range(0, last, (width + 1) // 2), last}:
            found.append(np.arange(count) - start)
            found[-1] = (found[-1] >= 0) & (found[-1] < width)
    return np.array(found, dtype=np.float32)


def _neighbours(count: int, reach: int = 2) -> NDArray[np.float32]:
    """(count, count): the mean over those up to `reach` away."""
    index = np.arange(count)
    near = (np.abs(index[:, None] - index) <= reach).astype(np.float32)
    return np.asarray(near / near.sum(axis=1, keepdims=True), np.float32)


def _checked(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or frame.size == 0:
        raise ValueError(f"required an image of uint8, got shape {frame.shape} {frame.dtype}")
    return frame
