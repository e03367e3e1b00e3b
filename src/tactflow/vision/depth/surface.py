"""The height map of a pressed gel, from its colour.

Only a window around the contact is used (`surroundings`), at half resolution: colours become slopes
(`slopes`), slopes become heights (`poisson`). The window ends where the gel is at rest, at height 0, or with
the picture.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes, Floats32
from tactflow.vision.compiled import kernel
from tactflow.vision.depth.possible import deepest_possible
from tactflow.vision.depth.slopes import MAX_HORIZONTAL_PART, SlopeModel, coordinates
from tactflow.vision.depth.surroundings import CELL_PX, MIN_GAIN, Resting, Window, resting, surroundings
from tactflow.vision.geometry.downsample import cell_means, halved
from tactflow.vision.types import Depth, Scale

LIGHT_OFFSET_GREY: Final = 20.0
"""Grey levels added to the light at rest before a change is divided by it, so that the noise of a dark
channel does not count as colour. Chosen by hand."""

UNEXPLAINED_ERROR: Final = 5.4
"""Relative error of depth and volume, over the share of the slopes (sum of squares) that no surface explains:
slopes made wrong by gloss, shadows or new colours contradict each other. This and the two below maximise the
likelihood of presses on five sensors and of 19 simulated scenes, each with the same weight. When the judged
sensor is left out, 78 % of the depths of real presses lie within one standard error and 94 % within two; of
the volumes 65 and 92 %. The error of balls that were not used for the calibration is not included: with it,
the likelihood of the presses of a left-out sensor is lower."""
STEEP_ERROR: Final = 0.235
"""The same where all slopes are steep; it grows with the root of the steep share."""
ROUNDING_ERROR: Final = 0.014
"""The same of any contact: averaging rounds it off."""
STEEP_FRACTION: Final = 0.95
"""A slope is steep above this fraction of the steepest of the calibration, by the horizontal part of the
normal."""

MIRRORED_RATIO: Final = 1.2
"""Share of the slopes that no surface explains, over that after left and right are exchanged, above which a
picture is mirrored. 122 presses of balls and an edge on five Minis, and mugs in a gripper, have at most 0.7,
their mirror images 2.0 or more; half way between, as a ratio."""
MIRRORED_MISFIT: Final = 0.2
"""Largest of the latter shares: the mirror images of these presses have 0.14 at most."""


class SurfaceErrors(NamedTuple):
    """Errors of a calibration: the largest horizontal part of a normal that it was fitted to, None where not
    known, and the relative difference of depths between sensors of its kind, if it was made with another
    one."""

    steepest: float | None = None
    between: float = 0.0


class Rest:
    """The untouched gel, prepared for `colour_change`, at half resolution.

    Parameters
    ----------
    untouched : (H, W, 3), BGR, without markers; H and W at least 8; of the dtype of the pictures that are
        compared with it, so that both are rounded alike.
    """

    def __init__(self, untouched: Bytes | Floats32) -> None:
        self.window = Window(0, untouched.shape[0] // 4 * 2, 0, untouched.shape[1] // 4 * 2)
        self.light = half_resolution(untouched)
        self.x, self.y = coordinates((self.window.right, self.window.bottom))
        self._cells = cell_means(self.light, CELL_PX // 2)
        self._cell_weight = np.reciprocal(self._cells + np.float32(LIGHT_OFFSET_GREY), dtype=np.float32)
        self._cell_level: Floats32 = self._cells * self._cell_weight

    def around(self, half: Bytes | Floats32, mask: Bytes) -> Resting:
        """Where the gel around a contact is at rest. half : `half_resolution` of a picture. mask : as
        `Surface.depth` takes it."""
        change = np.asarray(
            cv2.subtract(cell_means(half, CELL_PX // 2), self._cells, dtype=cv2.CV_32F), np.float32
        )
        return resting(change * self._cell_weight, self._cell_level, mask)


def half_resolution(image: Bytes | Floats32) -> Bytes | Floats32:
    """(H // 2, W // 2, 3) of the picture's dtype: means of 2 x 2 pixels of (H, W, 3), of uint8 rounded."""
    return halved(np.asarray(image, np.uint8)) if image.dtype == np.uint8 else cell_means(image, 2)


def colour_change(half: Bytes | Floats32, rest: Rest, window: Window, gain: Floats32) -> Floats32:
    """(h, w, 3) float32: change of the light in a window, relative to the light at rest.

    half : `half_resolution` of a picture without markers, grey levels, BGR. gain : (3,), `Resting.gain`: the
    picture is divided by it, so that a change of exposure or white balance is not a change of colour, and
    does not make slopes steeper or flatter.
    """
    change: Floats32 = np.empty((window.height, 3 * window.width), np.float32)
    loop = relative_change if half.dtype == rest.light.dtype == np.uint8 else relative_change.plain
    gain = np.maximum(gain, np.float32(MIN_GAIN))
    loop(_rows(half), _rows(rest.light), window.top, 3 * window.left, gain, LIGHT_OFFSET_GREY, change)  # type: ignore[arg-type]
    return change.reshape(window.height, window.width, 3)


@kernel
def relative_change(
    half: Bytes, light: Bytes, top: int, left: int, gain: Floats32, offset: float, change: Floats32
) -> None:
    """Fill `change`, (h, 3 w), of `colour_change`; exactly 0 where the gel has not changed.

    half, light : (H, 3 W), of the picture and of the untouched gel, used from row `top` and element `left`
    on. gain : (3,). offset : grey levels, `LIGHT_OFFSET_GREY`.
    """
    part = np.s_[top : top + len(change), left : left + change.shape[1]]
    resting = light[part].astype(np.float32)
    change[:] = (half[part] / np.tile(gain, change.shape[1] // 3) - resting) / (resting + np.float32(offset))


class Slopes(NamedTuple):
    """Slopes of the gel's surface in a window.

    Attributes
    ----------
    slope : (2, h, w) float32, growth to the right and down, towards the camera.
    window : of the picture.
    open_sides : those that the picture cuts off, see `Window.open_sides`.
    steep : share of the slopes that are steep, 0 to 1; None where no errors are known.
    """

    slope: Floats32
    window: Window
    open_sides: tuple[tuple[bool, bool], tuple[bool, bool]]
    steep: float | None


class Surface:
    """Height maps of a gel.

    Parameters
    ----------
    model : which colour is which slope; None where all slopes are given.
    scale : mm per px of the processed frame.
    errors : of the calibration; None where they are not known.
    thickness : of the gel, mm, which no depth exceeds; None where it is not known. See `deepest_possible`.

    Examples
    --------
    >>> model = SlopeModel(np.zeros((6, 19, 2)))
    >>> surface = Surface(model, Scale(0.1, 0.1, (0, 0), (0, 0)), SurfaceErrors(0.9))
    >>> gel, mask = np.full((64, 48, 3), 100, np.uint8), np.zeros((64, 48), np.uint8)
    >>> mask[20:30, 20:30] = 255
    >>> surface.depth(gel, Rest(gel), mask).greatest
    0.0
    """

    def __init__(
        self,
        model: SlopeModel | None,
        scale: Scale,
        errors: SurfaceErrors | None = None,
        thickness: float | None = None,
    ) -> None:
        self._model = model
        self._scale = scale
        self._errors = errors
        self._thickness = thickness

    def depth(self, image: Bytes, rest: Rest, mask: Bytes, gradients: Floats32 | None = None) -> Depth:
        """The height map of a frame.

        image : (H, W, 3) uint8, BGR, without markers. mask : (H, W) uint8, 255 in contact; not all 0.
        gradients : (H, W, 2), `tactflow.ports.Gradients`, instead of those of the model; then no errors are
        known.
        """
        return self.depth_of(self.slopes(image, rest, mask, gradients), mask)

    def depth_of(self, slopes: Slopes, mask: Bytes) -> Depth:
        """The height map of slopes. mask : that of `slopes`."""
        low, window, relative = self._integrated(slopes), slopes.window, None
        if self._errors is not None and slopes.steep is not None:
            unexplained = UNEXPLAINED_ERROR * self._unexplained(slopes.slope, low, mask[window.whole])
            relative = math.hypot(
                unexplained, STEEP_ERROR * math.sqrt(slopes.steep), self._errors.between, ROUNDING_ERROR
            )
        return measured(low, window, mask, self._scale, relative, self._thickness)

    def heights(self, image: Bytes, rest: Rest, mask: Bytes) -> Floats32:
        """(h, w) float32: how far the gel is pushed in, mm >= 0, at half resolution; see `depth`."""
        slopes = self.slopes(image, rest, mask)
        whole = np.zeros((rest.window.height, rest.window.width), np.float32)
        whole[slopes.window.part] = self._integrated(slopes)
        return whole

    def is_mirrored(self, slopes: Slopes) -> bool:
        """Whether slopes contradict each other less if left and right are exchanged.

        Of slopes from a mirrored picture only those along y have the right sign. No surface has such slopes:
        it explains about half of them, and nearly all once the others are turned around.
        """
        from tactflow.vision.depth.poisson import integrate

        window = slopes.window
        everywhere = np.full((2 * window.height, 2 * window.width), 255, np.uint8)

        def misfit(slope: Floats32) -> float:
            # Not cut off at 0, so that pits and saddles count as well as bumps.
            step = (-2 * self._scale.x, -2 * self._scale.y)
            return self._unexplained(slope, integrate(slope, step, slopes.open_sides), everywhere)

        exchanged = misfit(slopes.slope * np.array([-1, 1], np.float32)[:, None, None])
        return exchanged < MIRRORED_MISFIT and misfit(slopes.slope) > MIRRORED_RATIO * exchanged

    def slopes(self, image: Bytes, rest: Rest, mask: Bytes, gradients: Floats32 | None = None) -> Slopes:
        """The slopes of a frame; parameters as in `depth`."""
        half = half_resolution(image)
        at_rest = rest.around(half, mask)
        around = surroundings(mask, rest.window, at_rest.margin)
        window = around.window
        open_sides = window.open_sides(rest.window)
        if gradients is not None:
            # The model's slopes fall where the gel is pushed in.
            slope = -np.moveaxis(cell_means(gradients[window.whole], 2), -1, 0).astype(np.float32)
            return Slopes(slope, window, open_sides, None)
        change = colour_change(half, rest, window, at_rest.gain)
        assert self._model is not None, "without a model, gradients are given"
        rows, columns = window.part
        steepest = None if self._errors is None else self._errors.steepest
        slope = self._model.slopes(
            change,
            rest.x[columns],
            rest.y[rows],
            around.near,
            MAX_HORIZONTAL_PART if steepest is None else steepest,
        )
        return Slopes(slope, window, open_sides, _steep_part(slope, steepest))

    def _integrated(self, slopes: Slopes) -> Floats32:
        # Only here: runs without a calibration do not need SciPy's transforms.
        from tactflow.vision.depth.poisson import ALL_OPEN, integrate

        # A step is two processed pixels. Slopes rise towards the camera, into which the gel is pushed.
        heights = integrate(slopes.slope, (-2 * self._scale.x, -2 * self._scale.y), slopes.open_sides)
        if slopes.open_sides == ALL_OPEN:
            # The picture shows no border at rest; most of its border lies outside the contact.
            border = np.concatenate([heights[0], heights[-1], heights[:, 0], heights[:, -1]])
            # `np.median` takes ten times as long.
            middle = np.sort(border)[len(border) // 2 - 1 : len(border) // 2 + 1]
            heights -= middle.mean()
        return np.maximum(heights, 0, out=heights)

    def _unexplained(self, slope: Floats32, heights: Floats32, mask: Bytes) -> float:
        """Share of the squares of the slopes in contact that heights (h, w) do not explain. mask : (2 h, 2 w)
        uint8.

        Between two pixels heights fall by the mean of their slopes, as `integrate` has it.
        """
        contact = np.ascontiguousarray(mask[::2, ::2])
        total, left = slope_misfit(slope, heights, contact, self._scale.x, self._scale.y)
        return left / total if total else 0.0


@kernel
def slope_misfit(
    slope: Floats32, heights: Floats32, contact: Bytes, across: float, along: float
) -> tuple[float, float]:
    """Sums of squares, of twice the mean slope of two neighbours, and of what their heights leave of it.

    slope : (2, h, w). heights, contact : (h, w); pairs whose second pixel is not in contact do not count.
    across, along : half the steps to the right and down.
    """
    total = left = 0.0
    for axis, step in ((1, across), (0, along)):
        first, second = (np.s_[:, :-1], np.s_[:, 1:]) if axis else (np.s_[:-1], np.s_[1:])
        twice, inside = slope[1 - axis][first] + slope[1 - axis][second], contact[second] > 0
        total += float((twice[inside] ** 2).sum())
        twice += (heights[second] - heights[first]) / np.float32(step)
        left += float((twice[inside] ** 2).sum())
    return total, left


def measured(
    low: Floats32,
    window: Window,
    mask: Bytes,
    scale: Scale,
    relative_error: float | None,
    thickness: float | None = None,
) -> Depth:
    """Height map, greatest depth and volumes, from heights (h, w) of a window at half resolution, mm.

    Heights that exceed what is possible are scaled down to it, and what they exceed it by is part of the
    standard error.

    mask : (H, W) uint8, 255 in contact. relative_error : standard error of depth and volume; None: unknown.
    thickness : of the gel, mm; None: unknown.
    """
    greatest, most = float(low.max()), deepest_possible(mask, scale, thickness)
    if greatest > most:
        low = low * np.float32(most / greatest)
        if relative_error is not None:
            relative_error = math.hypot(relative_error, greatest / most - 1)
        greatest = most
    heights = np.zeros(mask.shape, np.float32)
    size = (2 * window.width, 2 * window.height)
    cv2.resize(low, size, heights[window.whole], interpolation=cv2.INTER_LINEAR)
    cell = scale.area(4.0)
    volume = cv2.norm(low, cv2.NORM_L1) * cell
    contact = np.ascontiguousarray(mask[window.whole][::2, ::2])
    pressed = cv2.norm(low, cv2.NORM_L1, contact) * cell
    if relative_error is None:
        return Depth(heights, greatest, None, volume, None, pressed)
    return Depth(heights, greatest, relative_error * greatest, volume, relative_error * volume, pressed)


def _steep_part(slope: Floats32, steepest: float | None) -> float:
    """Share of slopes (2, h, w) that are steep, 0 to 1; 0 where `steepest` is not known."""
    if steepest is None:
        return 0.0
    flat = STEEP_FRACTION * steepest
    length = cv2.magnitude(slope[0], slope[1])
    total = float(length.sum())
    cv2.threshold(length, flat / math.sqrt(1 - flat * flat), 0, cv2.THRESH_TOZERO, length)
    return float(length.sum()) / total if total else 0.0


def _rows(planes: Bytes | Floats32) -> Bytes | Floats32:
    """(h, 3 w), from (h, w, 3)."""
    return planes.reshape(len(planes), -1)
