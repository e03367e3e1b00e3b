"""How a frame of a gel differs from frames of it untouched: against the noise, under the light of the moment.

Frames are compared as means over cells of 4 x 4 px, lightly smoothed; where a contact is to be outlined, as
means over 2 x 2 px.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.contact.background_kernels import relative_change, smooth_cells, weigh_change
from tactflow.vision.contact.contact_outline import Lengths, lengths_of
from tactflow.vision.contact.illumination import LightChange, light_change, positions
from tactflow.vision.geometry.downsample import halved

Float = NDArray[np.float32]

CELL = 4
"""Side of a cell, px: averages 16 pixels, so that noise of 2 grey levels is half a level."""
_PRIOR = 8
"""Number of frames that the noise guessed from the first frame's own grain counts for."""
_QUANTISATION = 12**-0.5
"""Standard deviation of rounding to whole grey levels."""
_LEVELS = 6
"""Ranges of brightness for which noise is guessed separately (shot noise grows with the light)."""
_CORRELATED = 2.0
"""How much less than white noise the guessed noise shrinks by smoothing: demosaicing and video compression
leave little noise between neighbours, and more over distances."""
_DARK = 0.1
"""Part of the mean brightness that is added before changes are taken relative to the brightness."""
_SHARP = 0.05
"""Relative change by which an edge, moved by `shift`, begins to count less for the outline."""
_BLUR = 0.8
"""Standard deviation by which relative changes are smoothed, pixels at half resolution."""


@dataclass(frozen=True, slots=True)
class Change:
    """How a frame differs from the reference.

    half : the frame at half resolution. light : (3, 4), how its light differs, as `LightChange.fit` says.
    square : (h, w) float32, squared deviation of each cell, chi-square with three degrees of freedom where
    nothing touches. colour : the same of its colour alone, with two. evidence : the larger of both.
    largest, largest_colour : of `square` and `colour`. left : part of the change of the frame before that is
    left where that showed contact; 1 if it did not.
    """

    half: NDArray[np.uint8]
    light: Float
    square: Float
    colour: Float
    evidence: Float
    largest: float
    largest_colour: float
    left: float


@dataclass(frozen=True, slots=True)
class _Known:
    """The untouched gel: (h, w, 3) float32 at a quarter, (2h, 2w, 3) at half resolution."""

    mean: Float
    shade: Float
    weight: Float
    sharper: Float
    grey: Float
    light: LightChange
    half: Float
    half_shade: Float
    half_scale: Float


class UntouchedGel:
    """A gel that nothing touches, learned from one frame or several, to which others are compared.

    image : (H, W, 3) uint8, BGR grey levels, without markers. repeatability, tint, shift : as
    `ContactDetector` takes them.
    """

    def __init__(self, image: NDArray[np.uint8], repeatability: float, tint: float, shift: float) -> None:
        half, cells = _cells(image)
        self._half: Float = half.astype(np.float32)
        self._mean = _smoothed(cells)
        self._squares = np.zeros_like(self._mean)
        self._noise = _spatial_noise(cells)
        self._count = 1
        self._repeatability, self._tint, self._shift = repeatability, tint, shift
        self._known: _Known | None = None
        self._planes: _Planes | None = None

    def add(self, image: NDArray[np.uint8]) -> None:
        """Learn from one more frame of the same size; the more, the better the noise is known."""
        known = self._derived()
        half, cells = _cells(image)
        change = _change(_smoothed(cells), known)[0]
        count = self._count
        self._squares = self._squares + change * change * np.float32(count / (count + 1))
        self._mean = self._mean + change / np.float32(count + 1)
        self._half = self._half + (half - self._half) / np.float32(count + 1)
        self._count += 1
        self._known = self._planes = None

    def compare(
        self, image: NDArray[np.uint8], before: NDArray[np.bool_] | None, then: Float | None
    ) -> Change:
        """How a frame of the same size differs.

        before : (h, w) bool, cells in contact in the frame before; None if none was. then : its evidence.
        """
        known = self._derived()
        if self._planes is not None:
            return self._planes.compare(image, before, then)
        half, cells = _cells(image)
        change, found = _change(_smoothed(cells), known)
        square = _squared_length(change * known.weight)
        along = np.asarray(cv2.transform(change * known.grey, np.ones((1, 3), np.float32)), np.float32)
        along *= along
        # Without the part of the change in which all channels go along with the brightness.
        colour = np.asarray(cv2.subtract(square * known.sharper, along, dst=along), np.float32)
        evidence = np.maximum(square, colour)
        largest, largest_colour = cv2.minMaxLoc(square)[1], cv2.minMaxLoc(colour)[1]
        left = 1.0
        if before is not None and then is not None:
            inside = before.astype(np.float32).ravel()
            left = _part(float(inside @ evidence.ravel()), float(inside @ then.ravel()))
        return Change(half, found, square, colour, evidence, largest, largest_colour, left)

    def lengths(self, change: Change, rows: slice, columns: slice, inside: NDArray[np.bool_]) -> Lengths:
        """How strongly a window has changed relative to its brightness, at half resolution.

        change : of this frame. rows, columns : the window, cells. inside : which of its cells count.
        """
        known = self._derived()
        if self._planes is not None:
            return self._planes.lengths(change, rows, columns, inside)
        fine = slice(2 * rows.start, 2 * rows.stop), slice(2 * columns.start, 2 * columns.stop)
        answer = np.asarray(cv2.subtract(change.half[fine], known.half[fine], dtype=cv2.CV_32F), np.float32)
        expected = light_change(change.light, known.half_shade, *fine)
        answer -= expected
        answer *= known.half_scale[fine]
        answer = np.asarray(cv2.GaussianBlur(answer, (3, 3), _BLUR, dst=expected), np.float32)
        size = (2 * inside.shape[1], 2 * inside.shape[0])
        belongs = cv2.resize(inside.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        return lengths_of(answer, np.asarray(belongs, np.uint8))

    def _derived(self) -> _Known:
        if self._known is not None:
            return self._known
        mean, half, count = self._mean, self._half, self._count
        variance = (_PRIOR * self._noise**2 + self._squares) / (_PRIOR + count - 1)
        steady = variance * (1 + 1 / count) + (self._shift / CELL * _steepness(mean)) ** 2
        variance = steady + (self._repeatability * mean) ** 2
        light = LightChange(mean, np.asarray(variance, np.float32))
        weight = 1 / np.sqrt(variance)
        # One factor for all channels, so that a change in proportion to the brightness is none of colour.
        sharper = (variance / (steady + (self._tint * mean) ** 2)).min(axis=2)
        grey = mean * weight
        grey /= np.linalg.norm(grey, axis=2, keepdims=True) + np.float32(1e-6)
        dark = _DARK * half.mean(axis=(0, 1)) + 1
        edge = self._shift / 2 * _steepness(half) / (_SHARP * (half + dark))
        self._known = _Known(
            mean=mean,
            shade=light.shade(mean),
            weight=np.asarray(weight, np.float32),
            sharper=np.asarray(sharper, np.float32),
            grey=np.asarray(grey * weight * np.sqrt(sharper)[..., None], np.float32),
            light=light,
            half=half,
            half_shade=light.shade(half),
            half_scale=np.asarray(1 / ((half + dark) * np.sqrt(1 + edge**2)), np.float32),
        )
        if compiled.active():
            self._planes = _Planes(self._known)
        return self._known


class _Planes:
    """What `UntouchedGel` computes, by compiled loops over its channels one by one.

    Equal to it to the rounding of float32, relative 1e-5.
    """

    def __init__(self, known: _Known) -> None:
        self._mean, self._shade = _planes(known.mean), _planes(known.shade)
        self._weight, self._grey = _planes(known.weight), _planes(known.grey)
        self._sharper = np.ascontiguousarray(known.sharper)
        self._light = known.light
        self._half, self._half_shade = _planes(known.half), _planes(known.half_shade)
        self._half_scale = _planes(known.half_scale)
        self._beside, self._middle, _ = cv2.getGaussianKernel(3, _BLUR).ravel().tolist()
        self._shape = known.sharper.shape

    def compare(
        self, image: NDArray[np.uint8], before: NDArray[np.bool_] | None, then: Float | None
    ) -> Change:
        high, wide = self._shape
        half, cells = _cells(image)
        smooth = np.empty((3, high, wide), np.float32)
        smooth_cells(cells.reshape(high, -1), smooth)
        found = self._light.fit_planes(smooth)
        square, colour, evidence = np.empty((3, high, wide), np.float32)
        summary = np.empty(4)
        if before is None or then is None:
            before, then = _NO_CELLS, _NO_EVIDENCE
        weigh_change(
            smooth,
            found,
            positions(wide),
            positions(high),
            self._mean,
            self._shade,
            self._weight,
            self._grey,
            self._sharper,
            before.view(np.uint8),
            then,
            square,
            colour,
            evidence,
            summary,
        )
        largest, largest_colour, now, was = summary.tolist()
        return Change(half, found, square, colour, evidence, largest, largest_colour, _part(now, was))

    def lengths(self, change: Change, rows: slice, columns: slice, inside: NDArray[np.bool_]) -> Lengths:
        high, wide = 2 * inside.shape[0], 2 * inside.shape[1]
        strength, mean = np.empty((2, high, wide), np.float32)
        summary = np.empty(3)
        relative_change(
            change.half.reshape(len(change.half), -1),
            2 * rows.start,
            2 * columns.start,
            change.light,
            positions(change.half.shape[1]),
            positions(len(change.half)),
            self._half,
            self._half_shade,
            self._half_scale,
            np.ascontiguousarray(inside).view(np.uint8),
            self._beside,
            self._middle,
            strength,
            mean,
            summary,
        )
        return Lengths(strength, mean, *summary.tolist())


_NO_CELLS = np.zeros((0, 0), np.bool_)
_NO_EVIDENCE = np.zeros((0, 0), np.float32)


def _planes(picture: Float) -> Float:
    return np.ascontiguousarray(picture.transpose(2, 0, 1))


def _part(now: float, then: float) -> float:
    """Ratio of two changes, given the sums of their squares; 1 where there was none."""
    return math.sqrt(now / then) if then > 0 else 1.0


def _change(smooth: Float, known: _Known) -> tuple[Float, Float]:
    """Cells minus reference minus the light's change, and the latter's coefficients."""
    found = known.light.fit(smooth)
    expected = light_change(found, known.shade, slice(None), slice(None))
    expected += known.mean
    return np.subtract(smooth, expected, out=expected), found


def _squared_length(vectors: Float) -> Float:
    """(h, w) float32: sum over the three channels of the squares of (h, w, 3) float32, which are lost."""
    vectors *= vectors
    return np.asarray(cv2.transform(vectors, np.ones((1, 3), np.float32)), np.float32)


def _smoothed(cells: NDArray[np.uint8]) -> Float:
    return np.asarray(cv2.blur(cells.astype(np.float32), (3, 3)), np.float32)


def _cells(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Means over 2 x 2 px and over 4 x 4 px; the border is repeated to make whole cells."""
    bottom, right = -image.shape[0] % CELL, -image.shape[1] % CELL
    whole = np.ascontiguousarray(image)
    if bottom or right:
        whole = np.asarray(cv2.copyMakeBorder(whole, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    half = halved(whole)
    return half, halved(half)


def _steepness(picture: Float) -> Float:
    """Grey levels per cell by which the brightness changes, here or in the cells around."""
    along = cv2.Scharr(picture, cv2.CV_32F, 1, 0, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
    across = cv2.Scharr(picture, cv2.CV_32F, 0, 1, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.dilate(cv2.magnitude(along, across), np.ones((3, 3), np.uint8)), np.float32)


def _spatial_noise(picture: NDArray[np.uint8]) -> Float:
    """Standard deviation of smoothed cells guessed from one frame, as a function of brightness.

    Second differences of neighbouring cells see the noise and hardly the shading; their median is not moved
    by markers. Grain of the gel counts as noise here, which errs on the side of silence.
    """
    cells = picture.astype(np.float32)
    noise = np.full_like(cells, _QUANTISATION)
    if cells.shape[1] < 3:
        return noise
    second = np.abs(cells[:, :-2] - 2 * cells[:, 1:-1] + cells[:, 2:]) * np.float32(1.4826 / math.sqrt(6))
    for channel in range(3):
        level = cells[:, 1:-1, channel].ravel()
        order = np.argsort(level)
        parts = [part for part in np.array_split(order, _LEVELS) if part.size]
        center = [float(level[part].mean()) for part in parts]
        spread = [float(np.median(second[..., channel].ravel()[part])) for part in parts]
        noise[..., channel] = np.interp(cells[..., channel], center, spread)
    # Smoothing 3 x 3 would divide by three were the cells independent; demosaicing and compression see to
    # it that they are not quite.
    return np.asarray(np.hypot(noise, _QUANTISATION) * (_CORRELATED / 3), np.float32)
