"""What noise alone makes of the difference of two frames, learned while the probe runs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.change.tiles import Sample, Tiling

WARM_UP = 6
"""Pairs of frames from which the noise is learned before any frame is called unchanged. Chosen by hand."""
QUANTISATION = 1 / 12
"""Variance of rounding to whole grey levels, squared levels: noise below it cannot be seen. Derived: uniform
over one level."""

_WINDOWS = (1, 3, 7)
"""Widths and heights of the windows that are tested, tiles; also all tiles. Chosen by hand."""
_FORGETTING = 0.05
"""Weight of a new pair of frames in the running noise, 1. Chosen by hand."""
_QUIET = 9.0
"""Squared difference of a tile over what noise makes, 1, from which on the tile moves. Derived: three
standard deviations."""
_LOWER = 0.9
"""Two frames that differ by less than this fraction of what noise is thought to make show that it makes less.
Derived: a sum over a hundred thousand pixels is known to a percent."""
_MEDIAN = 0.455
"""Median of the square of a standard normal deviate."""
_MUCH_QUIETER = _MEDIAN / 4
"""Median of the tiles' squared differences over what noise makes, 1, below which the noise was learned while
something moved. Chosen by hand."""
_RAISE, _REDUCE = 1.25, 0.5
"""Factors, 1, that correct a noise that was learned too low, or too high, step by step. Chosen by hand."""
_LOUDER = 2
"""Variance of a tile over that of its neighbourhood, 1, from which on the tile is louder. Chosen by hand."""
_REACH = 2
"""Neighbours of a tile, to each side, that its noise is averaged over, tiles. Chosen by hand."""


class SsdNoise:
    """What a sum of squared differences of two frames is under noise alone.

    count : how many differences are summed.
    """

    def __init__(self, count: int) -> None:
        self.mean = 0.0
        self._spread = 0.0
        self._count = count
        self.rescale(1.0)

    def excess(self, ssd: float) -> float:
        """How far a sum is above what noise makes, in its standard deviations."""
        return (ssd - self.mean) * self._scale

    def learn(self, ssd: float, weight: float) -> None:
        """Take in the sum for two frames that show the same."""
        beyond = ssd - self.mean
        if beyond < (_LOWER - 1) * self.mean:
            self.mean, self._spread = ssd, 0.0
        else:
            self.mean += weight * beyond
            # What the first one is away from nothing says nothing.
            self._spread += weight * (beyond * beyond * (weight < 1) - self._spread)

    def rescale(self, doubt: float) -> None:
        """Make ready for `excess`. doubt : 1 / (number of sums that were learned)."""
        least = 2 * max(self.mean, 2 * QUANTISATION * self._count) ** 2 / self._count
        self._scale = 1 / math.sqrt(max(self._spread, least) * (1 + WARM_UP * doubt))


class NoiseModel:
    """What differences noise alone makes, learned from frames in a row.

    pairs : pairs of frames seen. ssd, coarse_ssd : of all lines, of a few. tests : how many values are
    compared with the bound in `strongest`.
    """

    def __init__(self, tiling: Tiling) -> None:
        rows, columns = tiling.grid
        self._unit = tiling.unit
        self._light = tiling.lights
        self._windows = _windows(rows), np.ascontiguousarray(_windows(columns).T)
        self._near = _neighbours(rows), np.ascontiguousarray(_neighbours(columns).T)
        self.tests = len(self._windows[0]) * self._unit.shape[1] * self._windows[1].shape[1]
        self.pairs = 0
        self.ssd = SsdNoise(tiling.count)
        self.coarse_ssd = SsdNoise(tiling.coarse_count)
        self._taught = 0
        # Of each sum, for one frame: as seen in its tile, and as used.
        self._seen = np.zeros_like(self._unit)
        self._variance = np.zeros_like(self._unit)
        self._rescale()

    def strongest(self, difference: NDArray[np.float32]) -> float:
        """The largest deviation of a difference of sums in any window, in its standard deviations."""
        return cv2.norm(_product(self._windows, difference) * self._scale, cv2.NORM_INF)

    def learn(self, now: Sample, last: Sample, bound: float) -> None:
        """Take in two frames in a row; a tile that moves teaches nothing, nor does a repeated frame."""
        self.pairs += 1
        ssd = now.ssd(last)
        if ssd == 0:
            return
        difference = now.sums() - last.sums()
        own = difference.copy()
        # What neighbours share is light that changes, and not noise.
        own[:, : self._light] -= self._smooth(difference)[:, : self._light]
        seen = np.square(own) * np.float32(0.5)
        self._taught += 1
        weight = max(_FORGETTING, 1 / self._taught)
        calm = self._taught <= WARM_UP
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
            if moves or typical < _MUCH_QUIETER:
                self._seen *= np.float32(_RAISE if moves else _REDUCE)
            calm = calm or moves or self.strongest(difference) <= bound
        if calm or ssd < _LOWER * self.ssd.mean:
            self.ssd.learn(ssd, weight)
            self.coarse_ssd.learn(now.coarse_ssd(last), weight)
        self._rescale()

    def _rescale(self) -> None:
        """From the variances of single tiles to the scales of all tests."""
        own = np.asarray(self._seen / self._unit, np.float32)
        # One tile's variance comes from few values, and its neighbours have nearly the same; only one that is
        # clearly louder is louder.
        level = np.maximum(np.maximum(self._smooth(own), own / _LOUDER), np.float32(QUANTISATION))
        self._variance = np.asarray(level * self._unit, np.float32)
        # What is known from few pairs only is allowed to be wrong.
        doubt = 1 / max(self._taught, 1)
        windows = _product(self._windows, self._variance) * np.float32(2 * (1 + doubt))
        self._scale = np.asarray(1 / np.sqrt(windows), np.float32)
        for model in (self.ssd, self.coarse_ssd):
            model.rescale(doubt)

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


def _neighbours(count: int) -> NDArray[np.float32]:
    """(count, count): the mean over those up to `_REACH` away."""
    index = np.arange(count)
    near = (np.abs(index[:, None] - index) <= _REACH).astype(np.float32)
    return np.asarray(near / near.sum(axis=1, keepdims=True), np.float32)
