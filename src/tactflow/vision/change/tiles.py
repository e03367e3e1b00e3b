"""Samples of a frame: some of its lines, and sums over tiles of them."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.compiled import helper, kernel

_LINES = 40
"""Lines of the frame that are read, about. Each costs a trip to memory: reading all of these takes 0.4 of the
time of copying the frame, and their sums as much again."""
_COARSE = 4
"""One in so many of these lines is read first; a contact that moves mostly shows in them, for 0.1 of the
time of copying the frame."""
_EDGES = 24
"""Samples of a tile on its steepest edges, 1. Chosen by hand."""
_SMOOTHING = 5
"""Side of the Gaussian window, px, that smooths a frame before its edges are looked for. Chosen by hand."""
_LEAST_VARIANCE = 1e-3
"""Variance, 1, of the sums of a tile without any gradient, which shows no motion: to divide by."""


class Tiling:
    """Where to look: which lines, how they are cut into tiles, and where the steepest edges of a tile are.

    Samples are laid out (lines, pixels, channels), with zeros added so that all tiles are equally large; sums
    (rows of tiles, kinds, tiles in a row), the kinds being light of each channel and of all, marks, and
    motion in x and y.

    frame : (H, W) or (H, W, C) uint8, of the untouched gel. tile : side of a tile, px, about.

    Attributes
    ----------
    slice, coarse : the rows of a frame that are read, and those that are read first. grid : (rows, columns)
    of tiles. width : of a tile, px. size : of samples with their zeros. used : (lines, pixels, channels)
    without them; count : all of these; coarse_count : those that are read first. lights : sums of light a
    tile, of the channels and of all. places : (tiles, samples) int32, flat indices of the samples on edges;
    resting : (tiles, samples) uint8, those samples of `frame`; slopes : (2, tiles, samples) float32, what
    they count in the sums of motion. heap : of `sum_tiles`. unit : variance of each sum for noise of variance
    1 that is independent from pixel to pixel.
    """

    def __init__(self, frame: NDArray[np.uint8], tile: int) -> None:
        frame = np.atleast_3d(frame)
        height, width, channels = frame.shape
        step = max(1, min(height // _LINES, tile))
        self.slice = slice(step // 2, None, step)
        self.coarse = slice(step // 2, None, _COARSE * step)
        lines = len(range(*self.slice.indices(height)))
        thick = max(1, min(lines, round(tile / step)))
        self.width = math.ceil(width / max(1, round(width / tile)))
        self.grid = rows, columns = math.ceil(lines / thick), math.ceil(width / self.width)
        self.size = rows * thick, columns * self.width, channels
        self.used = lines, width, channels
        self.count = math.prod(self.used)
        self.coarse_count = math.ceil(lines / _COARSE) * width * channels
        self.lights = channels + (channels > 1)
        self.heap = np.empty(math.prod(self.size[1:]), np.uint16)
        at_edges = self._choose_edges(frame)
        pixels = np.zeros(self.size, np.float32)
        pixels[:lines, :width] = 1
        unit = np.empty((rows, self.lights + 3, columns), np.float32)
        unit[:, :channels] = self._by_tile(pixels).sum(axis=-1).swapaxes(1, 2)
        unit[:, self.lights - 1] = unit[:, :channels].sum(axis=1)
        unit[:, self.lights :] = at_edges.reshape(-1, rows, columns).swapaxes(0, 1)
        # A tile without any gradient shows no motion, and no noise of it either.
        self.unit = np.maximum(unit, np.float32(_LEAST_VARIANCE))

    def _choose_edges(self, frame: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Find the steepest edges; returns (3, tiles): what the sums over them are of noise of variance 1."""
        lines, width, _ = self.used
        smooth = cv2.GaussianBlur(frame.astype(np.float32), (_SMOOTHING, _SMOOTHING), 0)
        gradients = np.zeros((2, *self.size), np.float32)
        for gradient, (x, y) in zip(gradients, ((1, 0), (0, 1)), strict=True):
            slope = np.atleast_3d(cv2.Sobel(smooth, cv2.CV_32F, x, y))
            gradient[:lines, :width] = slope[self.slice]
        steepness = np.full(self.size, -1, np.float32)
        steepness[:lines, :width] = np.hypot(*gradients)[:lines, :width]
        tiles = math.prod(self.grid)
        steepness = self._by_tile(steepness).reshape(tiles, -1)
        index = self._by_tile(np.arange(steepness.size).reshape(self.size)).reshape(tiles, -1)
        order = np.argsort(-steepness, axis=1, kind="stable")
        # A tile with too few pixels gives some of them several times.
        inside = np.count_nonzero(steepness >= 0, axis=1)[:, None]
        order = np.take_along_axis(order, np.arange(_EDGES) % np.minimum(inside, _EDGES), axis=1)
        self.places = np.take_along_axis(index, order, axis=1).astype(np.int32)
        resting = np.zeros(self.size, np.uint8)
        resting[:lines, :width] = frame[self.slice]
        self.resting = resting.reshape(-1)[self.places]
        self.slopes = np.ascontiguousarray(gradients.reshape(2, -1)[:, self.places])
        marks = np.full((1, tiles), _EDGES, np.float32)
        motion = np.square(np.ascontiguousarray(self.slopes.swapaxes(1, 2))).sum(axis=1)
        return np.concatenate([marks, motion])

    def _by_tile(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(lines, pixels, channels) as (rows, columns, channels, values of a tile)."""
        rows, columns = self.grid
        cut = values.reshape(rows, -1, columns, self.width, values.shape[2])
        return cut.transpose(0, 2, 4, 1, 3).reshape(rows, columns, values.shape[2], -1)


class Sample:
    """The lines of one frame: few of them at once, all and the sums over tiles once they are asked for."""

    def __init__(self, tiling: Tiling) -> None:
        self._tiling = tiling
        self._frame: NDArray[np.uint8] | None = None
        samples = np.zeros(tiling.size, np.uint8)
        lines, width, _ = tiling.used
        self._into = samples[:lines, :width]
        self._few_into = self._into[::_COARSE]
        self._lines = samples.reshape(len(samples), -1)
        self._few = self._lines[:lines:_COARSE]
        self._sums: NDArray[np.float32] | None = None

    def take(self, frame: NDArray[np.uint8]) -> None:
        """Begin with another frame."""
        self._sums = None
        self._frame = frame
        self._few_into[...] = frame[self._tiling.coarse].reshape(self._few_into.shape)

    def lines(self) -> NDArray[np.uint8]:
        """All lines, (lines, pixels * channels)."""
        if self._frame is not None:
            self._into[...] = self._frame[self._tiling.slice].reshape(self._into.shape)
            self._frame = None
        return self._lines

    def coarse_ssd(self, other: Sample) -> float:
        """Sum of squared differences over a few lines."""
        return cv2.norm(self._few, other._few, cv2.NORM_L2SQR)

    def ssd(self, other: Sample) -> float:
        """Sum of squared differences over all lines."""
        return cv2.norm(self.lines(), other.lines(), cv2.NORM_L2SQR)

    def sums(self) -> NDArray[np.float32]:
        """Sums over tiles, (rows, kinds, columns)."""
        if self._sums is None:
            tiling = self._tiling
            self._sums = np.empty(tiling.unit.shape, np.float32)
            sum_tiles(
                self.lines(),
                tiling.used[2],
                tiling.places,
                tiling.resting,
                tiling.slopes,
                tiling.heap,
                self._sums,
            )
        return self._sums


@kernel(
    "void(uint8[:, ::1], int64, int32[:, ::1], uint8[:, ::1], float32[:, :, ::1], uint16[::1], "
    "float32[:, :, ::1])",
)
def sum_tiles(
    lines: NDArray[np.uint8],
    channels: int,
    places: NDArray[np.int32],
    resting: NDArray[np.uint8],
    slopes: NDArray[np.float32],
    heap: NDArray[np.uint16],
    sums: NDArray[np.float32],
) -> None:
    """Sums over tiles of samples.

    lines : (lines, pixels * channels) uint8, less than 257 of them to a tile. places, resting, slopes : see
    `Tiling`. heap : (pixels * channels,) uint16, written over.
    sums : (rows, kinds, columns) float32, to be written. Whole numbers, but for those of motion.
    """
    rows, kinds, columns = sums.shape
    thick, width = lines.shape[0] // rows, lines.shape[1] // columns
    for row in range(rows):
        heap[:] = 0
        for line in range(row * thick, (row + 1) * thick):
            for x in range(heap.size):
                heap[x] += lines[line, x]
        for column in range(columns):
            _sum_light(heap[column * width : (column + 1) * width], channels, sums[row, : kinds - 3, column])
            tile = row * columns + column
            _sum_edges(
                lines.reshape(-1),
                places[tile],
                resting[tile],
                slopes[0, tile],
                slopes[1, tile],
                sums[row, kinds - 3 :, column],
            )


@helper
def _sum_light(samples: NDArray[np.uint16], channels: int, sums: NDArray[np.float32]) -> None:
    """Sums of each channel, and of all."""
    if channels == 3:
        blue, green, red = 0, 0, 0
        # All in one loop, which takes half the time of three.
        for x in range(samples.size // 3):
            blue += samples[3 * x]
            green += samples[3 * x + 1]
            red += samples[3 * x + 2]
        sums[0], sums[1], sums[2], sums[3] = blue, green, red, blue + green + red
        return
    together = 0
    for channel in range(channels):
        total = 0
        for x in range(channel, samples.size, channels):
            total += samples[x]
        sums[channel] = total
        together += total
    sums[sums.size - 1] = together


@helper
def _sum_edges(
    samples: NDArray[np.uint8],
    places: NDArray[np.int32],
    resting: NDArray[np.uint8],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Sums of what a tile's samples are above those at rest: as they are, times the slopes in x and in y."""
    marks, right, below = np.float32(0), np.float32(0), np.float32(0)
    for k in range(_EDGES):
        # Differences are small numbers, which single precision adds without loss.
        more = np.float32(samples[places[k]]) - np.float32(resting[k])
        marks += more
        right += more * across[k]
        below += more * down[k]
    sums[0], sums[1], sums[2] = marks, right, below
