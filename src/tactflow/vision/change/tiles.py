"""Samples of a frame: some of its lines, and sums over tiles of them."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

_LINES = 40
"""Lines of the frame that are read, about. Each costs a trip to memory: reading all of these takes 0.4 of the
time of copying the frame, and their sums as much again (docs/skipping.md)."""
_COARSE = 4
"""One in so many of these lines is read first; a contact that moves mostly shows in them, for 0.1 of the
time of copying the frame (docs/skipping.md)."""
_EDGES = 24
"""Samples of a tile on its steepest edges, 1. Chosen by hand."""
_SMOOTHING = 5
"""Side of the Gaussian window, px, that smooths a frame before its edges are looked for. Chosen by hand."""
_LEAST_VARIANCE = 1e-3
"""Variance, 1, of the sums of a tile without any gradient, which shows no motion: to divide by."""


class Tiling:
    """Where to look: which lines, how they are cut into tiles, and where the steepest edges of a tile are.

    Samples are laid out (lines, channels, pixels), with zeros added so that all tiles are equally large; sums
    (rows of tiles, kinds, tiles in a row), the kinds being light of each channel and of all, marks, and
    motion in x and y.

    frame : (H, W) or (H, W, C) uint8, of the untouched gel. tile : side of a tile, px, about.

    Attributes
    ----------
    slice, coarse : the rows of a frame that are read, and those that are read first. coarse_shape : of the
    latter. grid : (rows, columns) of tiles. width : of a tile, px. size : of samples with their zeros. used :
    (lines, pixels) without them; count : all of these. lights : sums of light a tile, of the channels and of
    all. collect : (rows of tiles, lines), adds lines up; together : adds channels up. places, weights : flat
    indices of the samples on edges, and what they count in the sums of marks and motion. resting : those
    samples of `frame`. ones : as many ones. unit : variance of each sum for noise of variance 1 that is
    independent from pixel to pixel.
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
        self.coarse = slice(step // 2, None, _COARSE * step)
        self.coarse_shape = frame[self.coarse].shape
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
        self.unit = np.maximum(unit, np.float32(_LEAST_VARIANCE))

    def _choose_edges(self, frame: NDArray[np.uint8]) -> None:
        """Flat indices (samples, tiles) of the steepest edges, and their weights in the sums there."""
        lines, width = self.used
        smooth = cv2.GaussianBlur(frame.astype(np.float32), (_SMOOTHING, _SMOOTHING), 0)
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


class Sample:
    """The lines of one frame: few of them at once, all and the sums over tiles once they are asked for."""

    def __init__(self, tiling: Tiling) -> None:
        self._tiling = tiling
        self._frame: NDArray[np.uint8] | None = None
        self._few = np.empty(tiling.coarse_shape, np.uint8)
        self._planes = np.zeros(tiling.size, np.uint8)
        lines, width = tiling.used
        self._into = [self._planes[:lines, channel, :width] for channel in range(tiling.channels)]
        self._sums: NDArray[np.float32] | None = None

    def take(self, frame: NDArray[np.uint8]) -> None:
        """Begin with another frame."""
        self._sums = None
        self._frame = frame
        self._few[...] = frame[self._tiling.coarse].reshape(self._few.shape)

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

    def coarse_ssd(self, other: Sample) -> float:
        """Sum of squared differences over a few lines."""
        return cv2.norm(self._few, other._few, cv2.NORM_L2SQR)

    def ssd(self, other: Sample) -> float:
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
