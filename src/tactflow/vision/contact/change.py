"""What the contact network sees of a frame: its change against the untouched gel, on a grid of cells."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import MAD_TO_SIGMA, Flags, Floats32, Mask
from tactflow.vision.types import Markers, MarkerStatus

CELLS: Final = 128
"""Cells along the longer side of a picture, whatever its size: contacts look alike to the network on pictures
of any resolution."""
MULTIPLE: Final = 16
"""The grid is padded with zeros to multiples of this: the network halves it four times."""
PLANES: Final = 12
"""Of `Change.planes`."""
LEAST_NOISE: Final = 0.3
"""Standard deviation of a cell, grey levels: rounding to whole grey levels alone leaves as much."""
CLEAR: Final = 6.0
"""Change, standard deviations of the noise, below which a frame shows no contact; and full scale at least."""
FULL_SCALE: Final = 0.99
"""Quantile of the changes that is full scale: a contact covers more than a hundredth of most pictures."""
MOST_DOTS: Final = 0.95
"""Quantile of the dots' displacements that is full scale: one in twenty may be mistaken for its neighbour."""
SPARSE: Final = 4
"""Exposure and noise are medians over every fourth cell of every fourth line: 770 of 128 x 96, for a
standard error of 0.05 of the scatter between cells."""
HALF: Final = 127
"""Mean of a valid area, 0 to 255, above which a cell shows gel."""
COARSE: Final = 4
"""Cells along the side of a block in which displacements of dots are averaged."""
LEAST_SHIFT: Final = 0.5
"""px: displacement that is full scale at least. Dots of a gel at rest stray by 0.1 to 0.2 px."""


class Change(NamedTuple):
    """How a frame differs from the untouched gel.

    planes : (12, h, w) float32, padded to multiples of 16 cells: the change of blue, green and red on a
    logarithmic scale of the noise; the same relative to the largest change; part of a cell that is hidden by
    dots; brightness of the untouched gel; displacement of the dots along x and y relative to the largest, how
    large that is, and how much is known of it.
    size : (h, w) of the grid without padding. largest : change anywhere, grey levels. noise : standard
    deviation of the change of a cell where nothing has changed, grey levels.
    """

    planes: Floats32
    size: tuple[int, int]
    largest: float
    noise: float

    @property
    def strength(self) -> float:
        """Largest change, standard deviations of the noise."""
        return self.largest / self.noise


class Untouched:
    """The untouched gel on the grid of cells: the mean of all frames (H, W, 3) uint8 that were added.

    valid : (H, W) uint8, 0 where the picture shows no gel: nothing changes there. None: gel is everywhere.
    """

    def __init__(self, image: NDArray[np.uint8], valid: Mask | None = None) -> None:
        self.shape = image.shape
        self.size = grid_size(image.shape)
        self.gel: Flags = np.ones(self.size, np.bool_)
        if valid is not None:
            self.gel = to_cells(valid, self.size) > HALF
        sparse = self.gel[::SPARSE, ::SPARSE]
        self._sparse: Flags = sparse if sparse.any() else np.ones_like(sparse)
        self._padded = tuple(-(-side // MULTIPLE) * MULTIPLE for side in self.size)
        self._count = 0
        self._mean: Floats32 = np.zeros((3, *self.size), np.float32)
        self.add(image)

    def add(self, image: NDArray[np.uint8]) -> None:
        """Take one more frame into the mean."""
        self._count += 1
        self._mean += (to_planes(image, self.size) - self._mean) / np.float32(self._count)

    def change(
        self,
        image: NDArray[np.uint8],
        hidden: Mask | None = None,
        markers: Markers | None = None,
    ) -> Change:
        """Compare a frame with the untouched gel.

        image : (H, W, 3) uint8, BGR grey levels, without markers. hidden : (H, W) uint8, not 0 where one was
        removed; None: nowhere. markers : those of this frame; None: unknown.

        The exposure of each channel is taken out as the median ratio, which a contact that covers less than
        half of the picture does not move. The noise is what differs between neighbouring cells in this frame.
        """
        now, before, sparse = to_planes(image, self.size), self._mean, self._sparse
        ratio = (now[:, ::SPARSE, ::SPARSE] + 1) / (before[:, ::SPARSE, ::SPARSE] + 1)
        exposure = np.median(ratio[:, sparse], axis=1)
        change = (now - before * exposure[:, None, None]) * self.gel
        smooth = np.stack([cv2.blur(plane, (3, 3)) for plane in change])
        noise = MAD_TO_SIGMA * float(np.median(np.abs(change - smooth)[:, ::SPARSE, ::SPARSE][:, sparse]))
        noise = max(noise, LEAST_NOISE)
        largest = np.abs(smooth[:, ::2, ::2]).ravel()
        scale = max(_quantile(largest, FULL_SCALE), CLEAR * noise)
        planes = np.zeros((PLANES, *self._padded), np.float32)
        inside = planes[:, : self.size[0], : self.size[1]]
        inside[0:3] = _logarithmic(change * np.float32(1 / noise)) / 3
        np.clip(change * np.float32(1 / scale), -2, 2, out=inside[3:6])
        if hidden is not None:
            inside[6] = to_cells(hidden, self.size) / 255
        inside[7] = before.mean(axis=0) / 128
        if markers is not None:
            inside[8:12] = dot_planes(markers, self.shape, self.size)
        return Change(planes, self.size, float(largest.max()), noise)


def grid_size(shape: tuple[int, ...]) -> tuple[int, int]:
    """(h, w) of the grid for a picture (H, W, ...).

    >>> grid_size((240, 320, 3))
    (96, 128)
    """
    scale = CELLS / max(shape[:2])
    return max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale))


def to_cells(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats32:
    """(h, w, ...) float32: means over cells; interpolated where a picture is smaller than the grid."""
    how = cv2.INTER_AREA if picture.shape[0] >= size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size[::-1], interpolation=how), np.float32)


def to_planes(picture: NDArray[np.uint8], size: tuple[int, int]) -> Floats32:
    """(3, h, w) float32 of a picture (H, W, 3)."""
    return np.stack(cv2.split(to_cells(picture, size)))


def _logarithmic(values: Floats32) -> Floats32:
    """Inverse hyperbolic sine: linear in small values, logarithmic in large ones."""
    size = np.abs(values)
    root = cv2.sqrt((size * size + 1).ravel())
    return np.copysign(np.asarray(cv2.log(size.ravel() + root.ravel())).reshape(values.shape), values)


def _quantile(values: Floats32, share: float) -> float:
    """Of values (N,), N >= 1, without interpolation, which is three times as fast."""
    index = round(share * (len(values) - 1))
    return float(np.partition(values, index)[index])


def dot_planes(markers: Markers, shape: tuple[int, ...], size: tuple[int, int]) -> Floats32:
    """(4, h, w) float32, the last four planes of `Change`: normalised convolution of the displacements.

    shape : of the picture. size : (h, w) of the grid. Dots that are not tracked do not count.
    """
    tracked = markers.status == MarkerStatus.TRACKED
    position = markers.position[tracked]
    shift = (position - markers.origin[tracked]).astype(np.float32)
    if len(shift) < 3:
        return np.zeros((4, *size), np.float32)
    scale = max(_quantile(np.hypot(shift[:, 0], shift[:, 1]), MOST_DOTS), LEAST_SHIFT)
    high, wide = -(-size[0] // COARSE), -(-size[1] // COARSE)
    blocks = np.clip(((position + 0.5) * (wide / shape[1])).astype(int), 0, (wide - 1, high - 1))
    sums = np.zeros((high, wide, 3), np.float32)
    np.add.at(sums, (blocks[:, 1], blocks[:, 0]), np.column_stack([shift / scale, np.ones(len(shift))]))
    pitch = math.sqrt(high * wide / len(shift))
    sums = np.asarray(cv2.GaussianBlur(sums, (0, 0), max(0.6 * pitch, 0.8)), np.float32)
    density = sums[..., 2:] * np.float32(pitch**2)
    known = np.minimum(density, 1)
    mean = np.clip(sums[..., :2] * np.float32(pitch**2) / np.maximum(density, 0.02), -2, 2)
    planes = np.concatenate([mean * known, math.asinh(scale / 0.2) / 3 * known, known], axis=2)
    grown = np.asarray(cv2.resize(planes, size[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    return grown.transpose(2, 0, 1)
