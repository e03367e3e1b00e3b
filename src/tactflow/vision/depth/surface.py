"""The height map of a pressed gel, from its colour.

Only a window around the contact is looked at, at half resolution: colours become slopes (`slopes`), slopes
become heights (`poisson`), and the border of the window, which lies outside the contact, is at rest.
"""

from __future__ import annotations

import math
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
BLUR: Final = 0.7
"""Standard deviation of the Gaussian over which colours are averaged, pixels at half resolution. It rounds
edges and takes off depth: 1.0 makes the errors of `press`, `cable` and `long_edge` a third larger, and 0.5
those under the light `mixed` a fifth. On wedge_ball the three differ by 2 %."""
MARGIN: Final = 0.75
"""How far the window reaches beyond the contact, relative to the contact's shorter side: the gel has sunk
around it too. Chosen on wedge_ball."""
LEAST_MARGIN: Final = 8
"""The same at least, pixels at half resolution. Chosen by hand."""
FADE: Final = 6
"""Pixels at half resolution over which slopes fade to 0 at the border of the window. Chosen by hand."""


OTHER: Final = 2.0
"""Errors of things that are no balls over those that a calibration has found with balls. This and the five
below were chosen on nine simulated scenes under three lights, so that 74 % of 114 errors of the depth lie
within one standard error and 92 % within two; on other contacts of these scenes 73 and 94 %."""
DEPTH_ROUNDED: Final = 0.05
"""Part of the depth that averaging may take off, of any contact."""
DEPTH_STEEP: Final = 0.2
"""Error of the depth, relative, where all of the slope is steep; it grows with the root of the steep part."""
VOLUME_ROUNDED: Final = 0.05
"""As `DEPTH_ROUNDED`, of the volume."""
VOLUME_STEEP: Final = 0.8
"""As `DEPTH_STEEP`, of the volume (75 % within one, 87 % within two; others 75 and 89 %)."""
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
    """Part of a picture at half resolution, px; its sides are even."""

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


class Rest:
    """The untouched gel, prepared for `colour_change`.

    untouched : (H, W, 3) uint8, BGR, without markers; H and W at least 8.
    """

    def __init__(self, untouched: Bytes) -> None:
        whole = Window(0, untouched.shape[0] // 4 * 2, 0, untouched.shape[1] // 4 * 2)
        self.window = whole
        self.light: Float = _halved(untouched, whole)
        self.weight: Float = np.reciprocal(self.light + np.float32(DIM))


def colour_change(image: Bytes, rest: Rest, window: Window) -> Float:
    """(h, w, 3) float32: change of the light at half resolution, relative to the light at rest.

    image : (H, W, 3) uint8, BGR, without markers. What the window's border shows, a change of the light as a
    whole, is taken out.
    """
    change: Float = _halved(image, window) - rest.light[window.part]
    change *= rest.weight[window.part]
    change -= np.median(_border(change), axis=0)
    return change


def contact_window(mask: Bytes, whole: Window) -> Window:
    """Window around the contact of a mask (H, W) uint8, not 0 in contact."""
    x, y, width, height = cv2.boundingRect(mask)
    margin = max(LEAST_MARGIN, round(MARGIN * min(width, height) / 2))
    top, bottom = _even(y // 2 - margin, (y + height) // 2 + margin, whole.bottom)
    left, right = _even(x // 2 - margin, (x + width) // 2 + margin, whole.right)
    return Window(top, bottom, left, right)


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

        image : (H, W, 3) uint8, BGR, without markers. mask : (H, W) uint8, not 0 in contact; not all 0.
        """
        window = contact_window(mask, rest.window)
        slope, steep = self._slopes(image, rest, window)
        low = self._integrated(slope)
        heights = np.zeros(mask.shape, np.float32)
        rows, columns = window.whole
        size = (columns.stop - columns.start, rows.stop - rows.start)
        heights[window.whole] = cv2.resize(low, size, interpolation=cv2.INTER_LINEAR)
        greatest = float(low.max())
        cell = self._scale.area(4.0)
        volume = float(low.sum()) * cell
        pressed = float(low[mask[window.whole][::2, ::2] > 0].sum()) * cell
        depth_error = volume_error = None
        if self._errors is not None:
            root = math.sqrt(steep)
            depth_error = greatest * math.hypot(OTHER * self._errors.depth, DEPTH_ROUNDED, DEPTH_STEEP * root)
            volume_error = volume * math.hypot(
                OTHER * self._errors.volume, VOLUME_ROUNDED, VOLUME_STEEP * root
            )
        return Depth(heights, greatest, depth_error, volume, volume_error, pressed)

    def heights(self, image: Bytes, rest: Rest, window: Window) -> Float:
        """(h, w) float32: how far the gel is pushed in, mm >= 0, in a window at half resolution."""
        return self._integrated(self._slopes(image, rest, window)[0])

    def _slopes(self, image: Bytes, rest: Rest, window: Window) -> tuple[Float, float]:
        """(2, h, w) float32, and the part of all slope that is steeper than the ball has shown, 0 to 1."""
        normal = self.normals(image, rest, window)
        flat = normal[0] * normal[0] + normal[1] * normal[1]
        slope = normal / np.sqrt(np.float32(1) - flat)
        slope *= _fading(window, rest.window)
        steepest = None if self._errors is None else self._errors.steepest
        if steepest is None:
            return slope, 0.0
        length = cv2.magnitude(slope[0], slope[1])
        total = float(length.sum())
        return slope, float(length[flat > (STEEP * steepest) ** 2].sum()) / total if total else 0.0

    def _integrated(self, slope: Float) -> Float:
        # Two processed pixels a step.
        heights = integrate(
            slope[0] * np.float32(-2 * self._scale.x), slope[1] * np.float32(-2 * self._scale.y)
        )
        heights -= np.median(_border(heights[..., None]))
        return np.maximum(heights, 0, out=heights)

    def normals(self, image: Bytes, rest: Rest, window: Window) -> Float:
        """(2, h, w) float32: x and y of the surface's normals in a window, as `SlopeModel.normals`."""
        size = (rest.window.right, rest.window.bottom)
        if size not in self._places:
            self._places = {size: place_terms(size)}
        place = self._places[size][:, window.top : window.bottom, window.left : window.right]
        return self._model.normals(colour_change(image, rest, window), place)


def _halved(image: Bytes, window: Window) -> Float:
    """(h, w, 3) float32: a window of a picture at half resolution, smoothed."""
    size = (window.right - window.left, window.bottom - window.top)
    half = cv2.resize(image[window.whole], size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(half, (0, 0), BLUR).astype(np.float32)


def _border(values: Float) -> Float:
    """(n, c): the outermost pixels of (h, w, c)."""
    return np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])


def _fading(window: Window, whole: Window) -> Float:
    """(h, w) float32: 1 inside, falling to 0 at those borders of a window that are not the picture's own."""
    rows, columns = (
        np.minimum(
            np.minimum(np.arange(high - low) + (FADE if low == 0 else 0), FADE),
            np.minimum(np.arange(high - low)[::-1] + (FADE if high == end else 0), FADE),
        )
        / np.float32(FADE)
        for low, high, end in (
            (window.top, window.bottom, whole.bottom),
            (window.left, window.right, whole.right),
        )
    )
    return np.outer(rows, columns).astype(np.float32)
