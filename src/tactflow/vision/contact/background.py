"""Background model of a gel: its mean and noise when untouched, and how far a frame deviates from them.

Frames are compared as means over cells of 4 x 4 px, lightly smoothed; to outline a contact, as means over
2 x 2 px.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import MAD_TO_SIGMA, SATURATED_GREY, Bytes, Flags, Floats32, Mask
from tactflow.vision.contact.background_kernels import (
    NEIGHBOUR_WEIGHT,
    smooth_cells,
    weigh_change,
    window_change,
)
from tactflow.vision.contact.dirt import light_directions
from tactflow.vision.contact.illumination import IlluminationModel, under_illumination
from tactflow.vision.geometry.downsample import halved
from tactflow.vision.geometry.valid_area import lit_area

CELL_PX: Final = 4
"""Side of a cell, px: averages 16 pixels, so that noise of 2 grey levels is half a level."""
PRIOR_WEIGHT_FRAMES: Final = 8
"""Weight, in frames, of the noise that is estimated from the grain of the first frame. Chosen by hand."""
QUANTISATION_STDDEV_GREY: Final = 12**-0.5
"""Standard deviation of rounding to whole grey levels, grey levels: that of a uniform variable of width 1."""
BRIGHTNESS_BIN_COUNT: Final = 6
"""Brightness ranges whose noise is estimated separately: shot noise grows with the light. Chosen by hand."""
CORRELATED_NOISE_RATIO: Final = 2.0
"""Ratio of the noise left by smoothing to that of white noise: demosaicing and video compression correlate
neighbouring pixels. Chosen by hand."""
MIN_CELL_VALID_MEAN: Final = 128
"""Minimum mean of the valid area, 0 to 255, over a cell that counts: half of the cell."""
NEARBY_SHARE: Final = 0.25
"""Side of the square over which the mean light nearby is taken, as a fraction of the longer side of the
picture: wider than most contacts, and narrower than the shadows of lamps."""


class Change(NamedTuple):
    """How a frame differs from the background.

    Attributes
    ----------
    half : (2h, 2w, 3) uint8, the frame at half resolution.
    illumination : (3, 4) float32, coefficients of `IlluminationModel.fit`.
    cells : (3, h, w) float32, signed change of each cell, in standard deviations that are the same for all
        channels; 0 where all are saturated, or where there is no gel. The variation of the light is relative
        to the brightness of the whole picture: relative to its own, a dark channel that a tilt lights up
        would dominate the others.
    deviations : (3, h, w) float32, of each cell: the squared deviation, chi-square with three degrees of
        freedom where nothing touches; the same for colour alone, with two degrees of freedom, or on a gray
        camera for the light minus its mean nearby; and the evidence, the larger of the two.
    largest, largest_colour : maxima of the first two.
    remaining : ratio of this change to that of the previous frame, over the cells that were in contact
        then; 1 if none was.
    dirt : (h, w) bool, cells that have been left out, or None.
    """

    half: Bytes
    illumination: Floats32
    cells: Floats32
    deviations: Floats32
    largest: float
    largest_colour: float
    remaining: float
    dirt: Flags | None = None

    def without(self, dirt: Flags) -> Change:
        """The same change but for some cells, (h, w) bool, which are set to 0 in place."""
        self.cells[:, dirt] = self.deviations[:, dirt] = 0
        largest, largest_colour = (float(values.max()) for values in self.deviations[:2])
        return self._replace(largest=largest, largest_colour=largest_colour, dirt=dirt)


class Derived(NamedTuple):
    """Quantities derived from the mean and noise of the untouched gel.

    Attributes
    ----------
    planes : (9, h, w) float32, of each cell: its mean and one over its standard deviation, of three channels
        each; one over the squared length of the weighted mean; how much more a change of colour counts than
        one of brightness; and the factor of `Change.cells`, one over the standard deviation.
    gray : whether all channels are the same.
    """

    illumination: IlluminationModel
    planes: Floats32
    gray: bool

    @classmethod
    def of(
        cls, mean: Floats32, steady: Floats32, repeatability: float, tint: float, gel: Flags | None = None
    ) -> Derived:
        """mean : grey levels. steady : variance that does not grow with the light, of the same shape.
        repeatability, tint : see `ContactDetector`. gel : (h, w) bool, cells that show it; None: all do.
        """
        variance = steady + (repeatability * mean) ** 2
        illumination = IlluminationModel(mean, np.asarray(variance, np.float32), gel)
        weight = 1 / np.sqrt(variance)
        # One factor for all channels: a change in proportion to the brightness must not count as colour.
        factor = (variance / (steady + (tint * mean) ** 2)).min(axis=0)
        length = np.linalg.norm(mean * weight, axis=0) + np.float32(1e-6)
        scale = 1 / np.sqrt(steady.max(axis=0) + (repeatability * mean.mean()) ** 2)
        # A saturated channel still darkens; where all are, nothing shows that the gel has brightened.
        scale = scale * (mean.min(axis=0) < SATURATED_GREY)
        if gel is not None:
            weight, scale = weight * gel, scale * gel
        planes = np.concatenate([mean, weight, [1 / length**2, factor, scale]])
        return cls(illumination, np.asarray(planes, np.float32), bool((mean == mean[0]).all()))

    def weigh(
        self, cells: Floats32, before: Floats32, change: Floats32, deviations: Floats32
    ) -> tuple[Floats32, float, float, float, float]:
        """Deviations of a frame's cells, (3, h, w), from the untouched gel.

        before, change, deviations, and all that is returned but the first, the illumination's coefficients :
        as for `weigh_change`.
        """
        coefficients = self.illumination.fit(cells)
        found = weigh_change(cells, coefficients, self.planes, before, change, deviations)
        if not self.gray:
            return coefficients, *found
        squared, local, evidence = deviations
        light = np.copysign(np.sqrt(squared / len(cells)), change[0])
        side = max(round(NEARBY_SHARE * max(light.shape)), 1)
        _, factor, _ = self.planes[6:]
        local[:] = np.square(light - cv2.blur(light, (side, side))) * factor
        np.maximum(squared, local, out=evidence)
        return coefficients, found[0], float(local.max()), float(evidence[before > 0].sum()), found[3]


class BackgroundModel:
    """Mean and noise of an untouched gel, learned from one frame or several.

    Computed in float32, with a relative error of 1e-5.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels, without markers.
    repeatability, tint, shift : see `ContactDetector`.
    valid : (H, W) uint8, 0 where there is no gel. Cells there never differ, and neither do cells where the
        gel is black. None: all cells show gel.

    Attributes
    ----------
    colours : of the light of each cell, see `light_directions`.

    Examples
    --------
    >>> import numpy as np
    >>> gel = np.full((64, 48, 3), 120, np.uint8)
    >>> model = BackgroundModel(gel, repeatability=0.025, tint=0.01, shift=1.0)
    >>> pressed = gel.copy()
    >>> pressed[20:40, 20:40] = 160
    >>> squared = model.compare(pressed, None).deviations[0]
    >>> squared.shape, bool(squared[7, 7] > 20 * squared[0, 0])
    ((16, 12), True)
    """

    def __init__(
        self, image: Bytes, repeatability: float, tint: float, shift: float, valid: Mask | None = None
    ) -> None:
        half = _halved(image)
        self._half = _planes(half)
        self._mean: Floats32 = _smoothed(half)
        self._squares = np.zeros_like(self._mean)
        self._noise = _spatial_noise(halved(half))
        self._gel = _gel_cells(half, valid)
        self._frames = 1
        self._repeatability, self._tint, self._shift = repeatability, tint, shift
        self._derive()

    @property
    def gray(self) -> bool:
        """Whether all channels are the same."""
        return self._derived.gray

    def add(self, image: Bytes) -> None:
        """Learn from one more frame of the same size; more frames estimate the noise better."""
        half = _halved(image)
        smooth = _smoothed(half)
        coefficients = self._derived.illumination.fit(smooth)
        change: Floats32 = smooth - under_illumination(self._mean, coefficients)
        count = self._frames
        self._squares = self._squares + change * change * np.float32(count / (count + 1))
        self._mean = self._mean + change / np.float32(count + 1)
        self._half = self._half + (_planes(half) - self._half) / np.float32(count + 1)
        self._frames += 1
        self._derive()

    def compare(self, image: Bytes, before: Floats32 | None) -> Change:
        """Compare a frame of the same size with the background.

        before : (h, w) float32, the previous frame's evidence in cells in contact, 0 elsewhere; None if
            nothing was in contact.
        """
        half = _halved(image)
        smooth = _smoothed(half)
        if before is None:
            before = np.zeros(smooth.shape[1:], np.float32)
        cells, deviations = np.empty((2, *smooth.shape), np.float32)
        light, largest, largest_colour, now, was = self._derived.weigh(smooth, before, cells, deviations)
        remaining = math.sqrt(now / was) if was > 0 else 1.0
        return Change(half, light, cells, deviations, largest, largest_colour, remaining)

    def window_change(
        self, change: Change, rows: slice, columns: slice, inside: Flags, mixtures: Floats32
    ) -> Floats32:
        """Signed change in a window, (k, 2 h, 2 w) float32, at half resolution, in standard deviations.

        change : of this frame. rows, columns : the window, cells. inside : (h, w) bool, the cells of it that
        count; the result is 0 in the others. mixtures : (k, 3) float32, weights of the channels.
        """
        picture = change.half.reshape(len(change.half), -1)
        shown = np.empty((len(mixtures), 2 * inside.shape[0], 2 * inside.shape[1]), np.float32)
        window = 2 * rows.start, 2 * columns.start, change.illumination, self._untouched, inside, mixtures
        window_change(picture, *window, shown, NEIGHBOUR_WEIGHT)
        return shown

    def _derive(self) -> None:
        """Derive what frames are compared with, so that the first one with contact does not wait for it."""
        mean, count = self._mean, self._frames
        noise = (PRIOR_WEIGHT_FRAMES * self._noise**2 + self._squares) / (PRIOR_WEIGHT_FRAMES + count - 1)
        steady = noise * (1 + 1 / count) + (self._shift / CELL_PX * _steepness(mean)) ** 2
        self._derived = Derived.of(mean, steady, self._repeatability, self._tint, self._gel)
        self._untouched = self._compared_with()
        self.colours = light_directions(mean, self._gel)

    def _compared_with(self) -> Floats32:
        """(2, 2 h, 6 w), interleaved: mean of the untouched gel, and one over its standard deviation.

        The variation of the light is relative to the brightness of the whole picture, as in `Change.cells`.
        """
        mean = self._half
        light = self._repeatability * mean.mean()
        variance = _fine_noise(mean) + light**2 + (self._shift / 2 * _steepness(mean)) ** 2
        scale = np.asarray(1 / np.sqrt(variance), np.float32)
        if self._gel is not None:
            scale = scale * self._gel.repeat(2, axis=0).repeat(2, axis=1)
        interleaved = np.ascontiguousarray(np.stack([mean, scale]).transpose(0, 2, 3, 1), np.float32)
        return interleaved.reshape(2, mean.shape[1], -1)


def _planes(picture: Bytes) -> Floats32:
    """(3, h, w) float32 of (h, w, 3)."""
    return np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32)


def _smoothed(half: Bytes) -> Floats32:
    """(3, h, w) float32: means over 3 x 3 cells of a picture at half resolution, (2 h, 2 w, 3)."""
    high, wide = half.shape[:2]
    planes = np.empty((3, high // 2, wide // 2), np.float32)
    smooth_cells(half.reshape(high, -1), planes)
    return planes


def _halved(image: Bytes) -> Bytes:
    """Means over 2 x 2 px; the border is replicated to make whole cells."""
    bottom, right = -image.shape[0] % CELL_PX, -image.shape[1] % CELL_PX
    whole = np.ascontiguousarray(image)
    if bottom or right:
        whole = np.asarray(cv2.copyMakeBorder(whole, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    return halved(whole)


def _gel_cells(half: Bytes, valid: Mask | None) -> Flags | None:
    """Cells (h, w) that show lit gel; None if all do. half : the gel at half resolution."""
    if valid is None:
        return None
    gel = lit_area(half)[::2, ::2]
    if not valid.all():
        cells = halved(_halved(np.repeat(valid[:, :, None], 3, axis=2)))
        gel = gel & (cells[:, :, 0] >= MIN_CELL_VALID_MEAN)
    return None if gel.all() else np.asarray(gel)


def _steepness(planes: Floats32) -> Floats32:
    """Largest gradient of the brightness in 3 x 3 cells, grey levels per cell; (3, h, w)."""
    steepness = np.empty_like(planes)
    for plane, largest in zip(planes, steepness, strict=True):
        across = cv2.Scharr(plane, cv2.CV_32F, 1, 0, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
        down = cv2.Scharr(plane, cv2.CV_32F, 0, 1, scale=1 / 32, borderType=cv2.BORDER_REPLICATE)
        cv2.dilate(cv2.magnitude(across, down), np.ones((3, 3), np.uint8), dst=largest)
    return steepness


def _spatial_noise(picture: Bytes) -> Floats32:
    """Standard deviation of smoothed cells, estimated from one frame as a function of brightness: (3, h, w).

    Second differences of neighbouring cells respond to noise and hardly to shading; their median is robust
    against markers. The grain of the gel counts as noise here, which makes false contacts rarer.
    """
    cells = _planes(picture)
    noise = np.full_like(cells, QUANTISATION_STDDEV_GREY)
    if cells.shape[2] < 3:
        return noise
    # The difference of white noise has six times its variance.
    scale = np.float32(MAD_TO_SIGMA / math.sqrt(6))
    second = np.abs(cells[..., :-2] - 2 * cells[..., 1:-1] + cells[..., 2:]) * scale
    for channel in range(3):
        level = cells[channel, :, 1:-1].ravel()
        order = np.argsort(level)
        bins = [part for part in np.array_split(order, BRIGHTNESS_BIN_COUNT) if part.size]
        center = [float(level[part].mean()) for part in bins]
        spread = [float(np.median(second[channel].ravel()[part])) for part in bins]
        noise[channel] = np.interp(cells[channel], center, spread)
    # Smoothing 3 x 3 independent cells divides the noise by three, but these are correlated.
    return np.asarray(np.hypot(noise, QUANTISATION_STDDEV_GREY) * (CORRELATED_NOISE_RATIO / 3), np.float32)


def _fine_noise(planes: Floats32) -> Floats32:
    """Variance of smoothed pixels at half resolution, estimated from a picture (3, 2 h, 2 w): (3, 1, 1).

    The sum of two pixels of a cell along one diagonal minus that along the other responds to noise, and
    hardly to shading or to blotches wider than a cell. To decide whether anything touches the gel, this
    estimate would be too low.
    """
    above, below = planes[:, ::2], planes[:, 1::2]
    diagonal = np.abs(above[:, :, ::2] - above[:, :, 1::2] - below[:, :, ::2] + below[:, :, 1::2])
    # The mean of four independent pixels is as noisy as a smoothed one.
    noise = np.median(diagonal, axis=(1, 2), keepdims=True) * (MAD_TO_SIGMA / 4)
    return np.asarray(
        (noise**2 + QUANTISATION_STDDEV_GREY**2) * (CORRELATED_NOISE_RATIO / 3) ** 2, np.float32
    )
