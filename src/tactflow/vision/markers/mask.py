"""Where markers cover the gel: spots unlike their surroundings on all sides, by two votes of three."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.geometry.downsample import halve_block, halved
from tactflow.vision.markers.detection import NoMarkersError, detect_markers
from tactflow.vision.markers.mask_kernels import contrast_with_circle, cover_spots

Polarity = Literal["dark", "bright"]

_DIRECTIONS = 12
"""Points on the circle around a spot that are compared with it."""
_RIM = 1.5
"""Soft rim of a dot that is covered too, pixels at half resolution: all that touch it, also by a corner."""
_SHARE = 0.25
"""Part of the dots' median contrast from which on something is a dot: worn dots keep that much."""
_LEAST = 6.0
"""Least contrast of a dot, grey levels: what the original script's threshold of 120 / 20 lets through."""


@dataclass(frozen=True, slots=True)
class Dot:
    """What the markers of a gel look like.

    radius : px, > 0. polarity : darker or brighter than the gel. contrast : least difference to the gel that
    counts as a marker, grey levels, > 0.
    """

    radius: float
    polarity: Polarity = "dark"
    contrast: float = _LEAST

    def __post_init__(self) -> None:
        if not (self.radius > 0 and math.isfinite(self.radius)):
            raise ValueError(f"radius: required > 0 px, got {self.radius}")
        if self.polarity not in ("dark", "bright"):
            raise ValueError(f"polarity: required 'dark' or 'bright', got {self.polarity!r}")
        if not (self.contrast > 0 and math.isfinite(self.contrast)):
            raise ValueError(f"contrast: required > 0 grey levels, got {self.contrast}")


def find_dot(
    image: NDArray[np.uint8],
    *,
    radius: float | None = None,
    polarity: Literal["dark", "bright", "auto"] = "auto",
) -> Dot | None:
    """Size, polarity and contrast of the markers of a gel, from a picture of the untouched gel.

    image : (H, W, 3) uint8, BGR grey levels. radius : px, if it is known. Returns None where there are none.
    """
    try:
        found = detect_markers(image, dot_radius=radius, polarity=polarity)
    except NoMarkersError:
        return None
    response = _response(halved(_even(image)), found.dot_radius, found.polarity)
    columns, rows = np.clip(np.rint((found.centers - 0.5) / 2).astype(int).T, 0, None)
    at = response[np.minimum(rows, response.shape[0] - 1), np.minimum(columns, response.shape[1] - 1)]
    return Dot(found.dot_radius, found.polarity, max(_LEAST, _SHARE * float(np.median(at))))


def marker_mask(image: NDArray[np.uint8], dot: Dot) -> NDArray[np.uint8]:
    """Mask of spots of a given size, with their soft rims, without shift.

    A difference of two scales, as in a difference of Gaussians, but its outer scale is the *least*
    contrast on a circle around the spot instead of a mean: so the edge of a contact, dark on one side only
    or along a line, is not taken for a marker. Works at half resolution.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    dot : what a marker looks like.

    Returns
    -------
    mask : (H, W) uint8, 255 on markers and their rims, else 0.

    Raises
    ------
    ValueError : if the image is not of that kind.

    References
    ----------
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"required a non-empty (H, W, 3) uint8 image, got shape {image.shape}, dtype {image.dtype}"
        )
    height, width = image.shape[:2]
    whole = _even(image)
    if compiled.active():
        mask = _compiled_mask(whole, dot)
    else:
        response = _response(halved(whole), dot.radius, dot.polarity)
        _, cores = cv2.threshold(response, dot.contrast, 255, cv2.THRESH_BINARY)
        grown = cv2.dilate(cores, _disc(_RIM))
        # Every pixel twice along a line, then every line twice: a quarter of the time of `cv2.resize`.
        mask = doubled(np.asarray(cv2.merge([grown, grown]).reshape(len(grown), -1), np.uint8))
    return np.ascontiguousarray(mask[:height, :width])


def doubled(lines: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Every line twice: (h, w) or (h, w, C) uint8 -> twice as high."""
    twice = np.empty((len(lines), 2, *lines.shape[1:]), np.uint8)
    twice[:, 0] = lines
    twice[:, 1] = lines
    return twice.reshape(2 * len(lines), *lines.shape[1:])


def halved_mask(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """255 where any of 2 x 2 pixels is not 0, else 0: (h, w) uint8, h and w even -> half as high and wide."""
    # A pixel of 255 in four leaves 64, and one of 1 none: so the mask is spread to 0 and 255 first.
    full = cv2.threshold(mask, 0, 255, cv2.THRESH_BINARY)[1]
    small = cv2.resize(full, (mask.shape[1] // 2, mask.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.threshold(small, 0, 255, cv2.THRESH_BINARY)[1], np.uint8)


def _even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with its last row and column repeated where their number is odd."""
    bottom, right = image.shape[0] % 2, image.shape[1] % 2
    if bottom or right:
        return np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    return np.ascontiguousarray(image)


class _Buffers:
    """What `_compiled_mask` computes in; the half-size picture has a margin as wide as the circle."""

    def __init__(self, height: int, width: int, radius: float, polarity: Polarity) -> None:
        rows, columns = _around(_outer(radius))
        reach = self.reach = len(_circle(_outer(radius))) // 2
        high, wide = height + 2 * reach, width + 2 * reach
        # Outside the frame nothing is as dark as a dot, or as bright.
        self.half = np.full((high, 3 * wide), 255 if polarity == "dark" else 0, np.uint8)
        self.inverted = np.empty_like(self.half)
        self.steps = 3 * (rows * wide + columns)
        self.contrast = np.zeros(self.half.size, np.uint8)
        self.spots = np.empty((high, wide), np.uint8)
        self.doubled = np.empty(2 * self.spots.size, np.uint8)


_kept = threading.local()
"""The buffers of each thread, for frames of one size and one kind of dot."""


def _compiled_mask(image: NDArray[np.uint8], dot: Dot) -> NDArray[np.uint8]:
    """`marker_mask` of an image of even height and width."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    kind = (height, width, dot.radius, dot.polarity)
    if getattr(_kept, "kind", None) != kind:
        _kept.kind, _kept.buffers = kind, _Buffers(*kind)
    own: _Buffers = _kept.buffers
    reach, picture = own.reach, own.half
    halve_block(image.reshape(len(image), -1), 0, 0, own.half, reach, reach, height, width, False)
    if dot.polarity == "bright":
        # A bright dot is a dark one in the negative.
        picture = np.invert(own.half, out=own.inverted)
    contrast_with_circle(picture, reach, own.steps, own.contrast)
    limit = min(255, math.floor(dot.contrast))
    mask = np.empty((2 * height, 2 * width), np.uint8)
    cover_spots(own.contrast, limit, reach, _corner(dot.radius), own.spots, own.doubled, mask)
    return mask


def _response(half: NDArray[np.uint8], radius: float, polarity: Polarity) -> NDArray[np.uint8]:
    """Contrast of each pixel with the least different one on a circle around it; median of the channels."""
    circle = _circle(_outer(radius))
    if polarity == "dark":
        contrast = cv2.subtract(cv2.erode(half, circle), half)
    else:
        contrast = cv2.subtract(half, cv2.dilate(half, circle))
    first, second, third = cv2.split(contrast)
    median = np.asarray(cv2.max(cv2.min(first, second), cv2.min(cv2.max(first, second), third)), np.uint8)
    # In a corner of the frame most of the circle is missing: any dark corner would be a spot.
    side = _corner(radius)
    for rows in (slice(0, side), slice(-side, None)):
        median[rows, :side] = 0
        median[rows, -side:] = 0
    return median


def _outer(radius: float) -> float:
    """Radius at half resolution of the circle that a dot of a radius at full resolution is compared with."""
    return (radius + max(radius, 4.0) + 1) / 2


def _corner(radius: float) -> int:
    """Side of the squares in the corners of the half-size frame in which no dot is looked for."""
    return len(_circle(_outer(radius))) // 4


@lru_cache(maxsize=32)
def _around(radius: float) -> NDArray[np.int64]:
    """Rows and columns of the places of a circle, from its centre: (2, _DIRECTIONS)."""
    turn = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    return np.rint(radius * np.stack([np.sin(turn), np.cos(turn)])).astype(np.int64)


@lru_cache(maxsize=32)
def _circle(radius: float) -> NDArray[np.uint8]:
    reach = int(np.ceil(radius))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.uint8)
    rows, columns = _around(radius) + reach
    kernel[rows, columns] = 1
    return kernel


@lru_cache(maxsize=32)
def _disc(radius: float) -> NDArray[np.uint8]:
    reach = int(radius)
    y, x = np.ogrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(x * x + y * y <= radius * radius, np.uint8)
