"""The height map of a pressed gel, from its colour.

Only a window around the contact is looked at, at half resolution: colours become slopes (`slopes`), slopes
become heights (`poisson`), and the border of the window, which lies outside the contact, is at rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.depth.poisson import integrate
from tactflow.vision.depth.slopes import Float, SlopeModel, place_terms
from tactflow.vision.types import Depth, Scale

Bytes = NDArray[np.uint8]

DIM: Final = 20.0
"""Grey levels that are added to the light at rest before a change is divided by it, so that the noise of a
dark channel does not count as colour. Chosen by hand."""
MARGIN: Final = 1.2
"""How far the gel may have sunk beyond the contact, relative to half of the contact's shorter axis. Chosen on
the simulator: 0.8 makes the errors of `press` twice and those of `finger` three times as large."""
LEAST_MARGIN: Final = 12
"""The same at least, pixels at half resolution. With 8, errors of `long_edge` are up to a tenth larger."""
BAND: Final = 24
"""Rows, at half resolution, of the bands in which pixels near the contact are computed. Chosen by hand: lower
ones fit it closer, and each costs some calls."""
FADE: Final = 6
"""Pixels at half resolution over which slopes fade to 0 at the border of the window. Chosen by hand."""


DEPTH_ROUNDED: Final = 0.01
"""Part of the depth that averaging may take off, of any contact. This and the three below were chosen on 162
contacts of nine simulated scenes under three lights, so that of round and of sharp ones about 68 % of the
errors lie within one standard error and 95 % within two; docs/depth_table.py tries them on 162 others."""
DEPTH_STEEP: Final = 0.17
"""Error of the depth, relative, where all of the slope is steep; it grows with the root of the steep part."""
VOLUME_ROUNDED: Final = 0.0075
"""As `DEPTH_ROUNDED`, of the volume."""
VOLUME_STEEP: Final = 0.26
"""As `DEPTH_STEEP`, of the volume."""
STEEP: Final = 0.86
"""A slope is steep from this part of the steepest on that the ball has shown, by the horizontal part of the
normal."""


class SurfaceErrors(NamedTuple):
    """What a calibration says of its heights: relative errors of depth and volume of balls that it has not
    seen, and the largest horizontal part of a normal that it was learned from, None where not known."""

    depth: float
    volume: float
    steepest: float | None = None


class Window(NamedTuple):
    """Part of a picture at half resolution, px."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def part(self) -> tuple[slice, slice]:
        """Rows and columns at half resolution."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def whole(self) -> tuple[slice, slice]:
        """Rows and columns at full resolution."""
        return slice(2 * self.top, 2 * self.bottom), slice(2 * self.left, 2 * self.right)


class Surroundings(NamedTuple):
    """Where the gel may have sunk: a window, and the parts of it, one below the other, that are near the
    contact. Elsewhere the gel is at rest."""

    window: Window
    bands: list[Window]


class Rest:
    """The untouched gel, prepared for `colour_change`.

    untouched : (H, W, 3), BGR, without markers; H and W at least 8; of the dtype of the pictures that are
    compared with it, so that both are rounded alike.
    """

    def __init__(self, untouched: Bytes | Float) -> None:
        whole = Window(0, untouched.shape[0] // 4 * 2, 0, untouched.shape[1] // 4 * 2)
        self.window = whole
        self.light: Float = np.stack(_halved(untouched, whole)).astype(np.float32)
        self.weight: Float = np.reciprocal(self.light + np.float32(DIM))


def colour_change(image: Bytes | Float, rest: Rest, window: Window) -> Float:
    """(3, h, w) float32: change of the light at half resolution, relative to the light at rest.

    image : (H, W, 3) uint8 or float32, grey levels, BGR, without markers; means of 2 x 2 pixels of uint8 are
    rounded. What the window's border shows, a change of the light as a whole, is taken out.
    """
    part = (slice(None), *window.part)
    light, weight = rest.light[part], rest.weight[part]
    change = np.empty(light.shape, np.float32)
    for channel, now in enumerate(_halved(image, window)):
        cv2.subtract(now, light[channel], change[channel], dtype=cv2.CV_32F)
    change *= weight
    change -= _median(_border(change))[:, None, None]
    return change


def surroundings(mask: Bytes, whole: Window, relative: float = MARGIN) -> Surroundings:
    """Around the contact of a mask (H, W) uint8, 255 in contact; not all 0.

    relative : how far, in halves of the contact's shorter axis; `LEAST_MARGIN` at least.
    """
    x, y, width, height = cv2.boundingRect(mask)
    box = Window(
        y // 2, min((y + height + 1) // 2, whole.bottom), x // 2, min((x + width + 1) // 2, whole.right)
    )
    if box.top >= box.bottom or box.left >= box.right:
        return Surroundings(Window(*whole), [])
    size = (box.right - box.left, box.bottom - box.top)
    contact = cv2.resize(mask[box.whole], size, interpolation=cv2.INTER_AREA)
    margin = max(LEAST_MARGIN, round(relative * _shorter_axis(cv2.moments(contact, binaryImage=True)) / 2))
    top, bottom = _even(box.top - margin, box.bottom + margin, whole.bottom)
    left, right = _even(box.left - margin, box.right + margin, whole.right)
    window = Window(top, bottom, left, right)
    near = np.zeros((bottom - top, right - left), np.uint8)
    near[box.top - top : box.bottom - top, box.left - left : box.right - left] = contact
    reach = 2 * margin + 1
    near = np.asarray(cv2.dilate(near, cv2.getStructuringElement(cv2.MORPH_RECT, (reach, reach))), np.uint8)
    bands = []
    for low in range(0, bottom - top, BAND):
        columns = np.flatnonzero(near[low : low + BAND].any(axis=0))
        if len(columns):
            first, last = left + int(columns[0]), left + int(columns[-1]) + 1
            bands.append(Window(top + low, min(top + low + BAND, bottom), first, last))
    return Surroundings(window, bands)


def _shorter_axis(moments: Mapping[str, float]) -> float:
    """Shorter axis of the ellipse that has these second moments, px: of a disc its diameter."""
    area = moments["m00"]
    if not area:
        return 0.0
    mean, half = (moments["mu20"] + moments["mu02"]) / 2, (moments["mu20"] - moments["mu02"]) / 2
    return 4 * math.sqrt(max(mean - math.hypot(half, moments["mu11"]), 0.0) / area)


def _even(low: int, high: int, end: int) -> tuple[int, int]:
    """A range within 0 and `end`, an even number, of even length: the cosine transform takes no other."""
    low, high = max(0, low), min(end, high)
    return (low, high) if (high - low) % 2 == 0 else (low, high + 1) if high < end else (low - 1, high)


class Surface:
    """Height maps of a gel.

    Parameters
    ----------
    model : which colour is which slope. scale : mm per px of the processed frame.
    errors : of the calibration; None where they are not known.

    Examples
    --------
    >>> model = SlopeModel(np.zeros((6, 19, 2)))
    >>> surface = Surface(model, Scale(0.1, 0.1, (0, 0), (0, 0)), SurfaceErrors(0.05, 0.1))
    >>> gel, mask = np.full((64, 48, 3), 100, np.uint8), np.zeros((64, 48), np.uint8)
    >>> mask[20:30, 20:30] = 255
    >>> surface.depth(gel, Rest(gel), mask).greatest
    0.0
    """

    def __init__(self, model: SlopeModel, scale: Scale, errors: SurfaceErrors | None = None) -> None:
        self._model = model
        self._scale = scale
        self._errors = errors
        self._places: dict[tuple[int, int], Float] = {}

    def depth(self, image: Bytes, rest: Rest, mask: Bytes) -> Depth:
        """The height map of a frame.

        image : (H, W, 3) uint8, BGR, without markers. mask : (H, W) uint8, 255 in contact; not all 0.
        """
        around = surroundings(mask, rest.window)
        window = around.window
        slope, steep = self._slopes(image, rest, around)
        low = self._integrated(slope)
        heights = np.zeros(mask.shape, np.float32)
        rows, columns = window.whole
        size = (columns.stop - columns.start, rows.stop - rows.start)
        heights[window.whole] = cv2.resize(low, size, interpolation=cv2.INTER_LINEAR)
        greatest = float(low.max())
        cell = self._scale.area(4.0)
        volume = float(low.sum()) * cell
        pressed = float((low * (mask[window.whole][::2, ::2] > 0)).sum()) * cell
        depth_error = volume_error = None
        if self._errors is not None:
            root = math.sqrt(steep)
            depth_error = greatest * math.hypot(self._errors.depth, DEPTH_ROUNDED, DEPTH_STEEP * root)
            volume_error = volume * math.hypot(self._errors.volume, VOLUME_ROUNDED, VOLUME_STEEP * root)
        return Depth(heights, greatest, depth_error, volume, volume_error, pressed)

    def heights(self, image: Bytes, rest: Rest, around: Surroundings) -> Float:
        """(h, w) float32: how far the gel is pushed in, mm >= 0, in a window at half resolution."""
        return self._integrated(self._slopes(image, rest, around)[0])

    def _slopes(self, image: Bytes, rest: Rest, around: Surroundings) -> tuple[Float, float]:
        """(2, h, w) float32, and the part of all slope that is steeper than the ball has shown, 0 to 1."""
        window = around.window
        change = colour_change(image, rest, window)
        places = self._places_of(rest.window)
        slopes = np.zeros((2, *change.shape[1:]), np.float32)
        steepest = None if self._errors is None else self._errors.steepest
        total = steep = 0.0
        for band in around.bands:
            here = (
                slice(None),
                slice(band.top - window.top, band.bottom - window.top),
                slice(band.left - window.left, band.right - window.left),
            )
            normal = self._model.normals(change[here], places[(slice(None), *band.part)])
            flat = normal[0] * normal[0] + normal[1] * normal[1]
            normal /= np.sqrt(np.float32(1) - flat)
            slopes[here] = normal
            if steepest is not None:
                length = cv2.magnitude(normal[0], normal[1])
                total += float(length.sum())
                steep += float((length * (flat > (STEEP * steepest) ** 2)).sum())
        _fade(slopes, window, rest.window)
        return slopes, steep / total if total else 0.0

    def _places_of(self, whole: Window) -> Float:
        """(6, H, W) float32, `place_terms` of all pixels at half resolution."""
        size = (whole.right, whole.bottom)
        if size not in self._places:
            self._places = {size: place_terms(size)}
        return self._places[size]

    def _integrated(self, slope: Float) -> Float:
        # Two processed pixels a step.
        heights = integrate(
            slope[0] * np.float32(-2 * self._scale.x), slope[1] * np.float32(-2 * self._scale.y)
        )
        heights -= _median(_border(heights[None]))
        return np.maximum(heights, 0, out=heights)


def _halved(image: Bytes | Float, window: Window) -> Sequence[Bytes | Float]:
    """Three (h, w) of the picture's dtype: the channels of a window of it at half resolution."""
    size = (window.right - window.left, window.bottom - window.top)
    return cv2.split(cv2.resize(image[window.whole], size, interpolation=cv2.INTER_AREA))  # type: ignore[return-value]


def _border(values: Float) -> Float:
    """(c, n): the outermost pixels of (c, h, w)."""
    return np.concatenate([values[:, 0], values[:, -1], values[:, :, 0], values[:, :, -1]], axis=1)


def _median(values: Float) -> Float:
    """(c,): the middle ones of (c, n). `np.median` takes four times as long for so few."""
    middle = values.shape[1] // 2
    return np.partition(values, middle, axis=1)[:, middle]


def _fade(slopes: Float, window: Window, whole: Window) -> None:
    """Let slopes (2, h, w) fall to 0 at those borders of a window that are not the picture's own."""
    height, width = slopes.shape[1:]
    across, down = (
        np.arange(min(FADE, side), dtype=np.float32) / np.float32(FADE) for side in (width, height)
    )
    if window.left > 0:
        slopes[:, :, : len(across)] *= across
    if window.right < whole.right:
        slopes[:, :, -len(across) :] *= across[::-1]
    if window.top > 0:
        slopes[:, : len(down)] *= down[:, None]
    if window.bottom < whole.bottom:
        slopes[:, -len(down) :] *= down[::-1, None]
