"""Mask of the markers: spots that differ from their surroundings on all sides."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import cv2
import numpy as np

from tactflow.vision.arrays import Bytes, check_color_image
from tactflow.vision.compiled import kernel
from tactflow.vision.geometry.downsample import halved
from tactflow.vision.markers.detection import Detection, NoMarkersError, detect_markers
from tactflow.vision.markers.selection import Polarity
from tactflow.vision.markers.spots import SAME_SIZE_RATIO

CIRCLE_POINTS: Final = 12
"""Number of points on the circle that a spot is compared with. Chosen by hand."""

MIN_CIRCLE_DISTANCE_PX: Final = 4.0
"""Minimum distance of the circle from the centre's dot, px, so that the blurred border of a small dot is not
taken for gel. Chosen by hand."""

CONTRAST_FRACTION: Final = 0.25
"""Minimum contrast of a dot, relative to the median. Worn dots keep that much. Chosen by hand."""

MIN_CONTRAST_GREY: Final = 6.0
"""Minimum contrast of a dot, grey levels: 120 / 20, the threshold of the original script over its gain."""


@dataclass(frozen=True, slots=True)
class Dot:
    """Appearance of the markers of a gel.

    Attributes
    ----------
    radius : px, > 0.
    polarity : darker or brighter than the gel.
    contrast : minimum difference of a marker to the gel, grey levels, > 0.
    others : radii of markers of other sizes, px, each > 0.
    """

    radius: float
    polarity: Polarity = "dark"
    contrast: float = MIN_CONTRAST_GREY
    others: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for radius in (self.radius, *self.others):
            if not (radius > 0 and math.isfinite(radius)):
                raise ValueError(f"radius: required > 0 px, got {radius}")
        if self.polarity not in ("dark", "bright"):
            raise ValueError(f"polarity: required 'dark' or 'bright', got {self.polarity!r}")
        if not (self.contrast > 0 and math.isfinite(self.contrast)):
            raise ValueError(f"contrast: required > 0 grey levels, got {self.contrast}")


def find_dot(
    image: Bytes,
    *,
    radius: float | None = None,
    polarity: Literal["dark", "bright", "auto"] = "auto",
    valid: Bytes | None = None,
    detect: Callable[..., Detection] = detect_markers,
) -> Dot | None:
    """Estimate size, polarity and contrast of the markers from a picture of the untouched gel.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    radius : of a marker, px, if it is known.
    polarity : of the markers; "auto" takes the better lattice.
    valid : (H, W) uint8, non-zero where there is gel; None: everywhere.
    detect : called like `detect_markers`; may return what it has found in this picture before.

    Returns
    -------
    dot : appearance of the markers; None if there are none.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> dot = find_dot(open_scene("press?frames=2").frame(0))
    >>> dot.polarity
    'dark'
    """
    try:
        found = detect(image, dot_radius=radius, polarity=polarity, valid=valid)
    except NoMarkersError:
        return None
    contrast = np.median(_contrast(_even(image), found.dot_radius, found.polarity), axis=2)
    columns, rows = np.clip(np.rint((found.centers - 0.5) / 2).astype(int).T, 0, None)
    at = contrast[np.minimum(rows, contrast.shape[0] - 1), np.minimum(columns, contrast.shape[1] - 1)]
    least = max(MIN_CONTRAST_GREY, CONTRAST_FRACTION * float(np.median(at)))
    return Dot(found.dot_radius, found.polarity, least, _other_sizes(found))


def _other_sizes(found: Detection) -> tuple[float, ...]:
    """Radii, px, of marks for which the circle of the usual size does not fit."""
    if found.radii is None:
        return ()
    # A circle fits marks that are smaller or larger by up to this ratio.
    step = np.rint(np.log(found.radii / found.dot_radius) / np.log(SAME_SIZE_RATIO**2))
    sizes, counts = np.unique(step, return_counts=True)
    return tuple(float(np.median(found.radii[step == s])) for s in sizes[(counts > 1) & (sizes != 0)])


def marker_mask(image: Bytes, dot: Dot) -> Bytes:
    """Mask of spots of a given size and their soft borders.

    A spot differs by more than `dot.contrast` from every point on a circle around it, in at least two of the
    three channels. A difference of Gaussians compares with the mean of the surroundings instead; the least
    difference keeps the edge of a contact, dark on one side or along a line, out of the mask.

    Parameters
    ----------
    image : (H, W, 3) uint8, BGR grey levels.
    dot : appearance of the markers.

    Returns
    -------
    mask : (H, W) uint8, 255 on markers, else 0. It is computed at half resolution, so it consists of blocks
        of 2 x 2 px, and every spot is dilated by one block to cover its soft border.

    Raises
    ------
    ValueError : the image has another type or shape.

    Examples
    --------
    >>> import cv2
    >>> gel = np.full((60, 80, 3), 150, np.uint8)
    >>> mask = marker_mask(cv2.circle(gel, (40, 30), 5, (30, 30, 30), -1), Dot(radius=5))
    >>> int(mask[30, 40]), int(mask[30, 60])
    (255, 0)
    """
    check_color_image(image)
    whole = _even(image)
    mask = _mask(whole, dot, dot.radius)
    for radius in dot.others:
        mask |= _mask(whole, dot, radius)
    return np.ascontiguousarray(mask[: image.shape[0], : image.shape[1]])


def _mask(whole: Bytes, dot: Dot, radius: float) -> Bytes:
    """The mask of dots of one size, of an image of even height and width."""
    mask = np.empty(whole.shape[:2], np.uint8)
    contrast = _contrast(whole, radius, dot.polarity)
    cover_spots(contrast, min(255, math.floor(dot.contrast)), _corner(radius), mask)
    return mask


def _even(image: Bytes) -> Bytes:
    """The image with its last row or column repeated if the number of rows or columns is odd."""
    bottom, right = image.shape[0] % 2, image.shape[1] % 2
    if bottom or right:
        return np.asarray(cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE), np.uint8)
    return np.ascontiguousarray(image)


def _contrast(whole: Bytes, radius: float, polarity: Polarity) -> Bytes:
    """Smallest contrast of each px with a circle around it: (H / 2, W / 2, 3) uint8, grey levels."""
    half, circle = halved(whole), _circle(_circle_radius(radius))
    # Points outside the frame are ignored.
    if polarity == "dark":
        return np.asarray(cv2.subtract(cv2.erode(half, circle), half), np.uint8)
    return np.asarray(cv2.subtract(half, cv2.dilate(half, circle)), np.uint8)


def _circle_radius(radius: float) -> float:
    """Radius of the circle at half resolution for a dot whose radius is given at full resolution."""
    return (radius + max(radius, MIN_CIRCLE_DISTANCE_PX) + 1) / 2


def _corner(radius: float) -> int:
    """Side, px, of the squares in the corners of the half-size frame where no dots are searched.

    Most of the circle lies outside there, so any dark corner would be a spot.
    """
    return (2 * math.ceil(_circle_radius(radius)) + 1) // 4


@lru_cache(maxsize=32)
def _circle(radius: float) -> Bytes:
    """Structuring element: 1 at `CIRCLE_POINTS` points of a circle."""
    turn = np.arange(CIRCLE_POINTS) * (2 * np.pi / CIRCLE_POINTS)
    reach = math.ceil(radius)
    rows, columns = np.rint(radius * np.stack([np.sin(turn), np.cos(turn)])).astype(int) + reach
    circle = np.zeros((2 * reach + 1, 2 * reach + 1), np.uint8)
    circle[rows, columns] = 1
    return circle


@kernel
def cover_spots(contrast: Bytes, threshold: int, corner: int, mask: Bytes) -> None:
    """Fill `mask`, (2 h, 2 w): 255 on and next to px whose median contrast exceeds a threshold, else 0.

    contrast : (h, w, 3). threshold : grey levels. corner : side of squares in the corners without spots, px.
    """
    spots = np.where(np.median(contrast, axis=2) > threshold, np.uint8(255), np.uint8(0))
    height, width = spots.shape
    for rows in (slice(0, corner), slice(max(height - corner, 0), height)):
        spots[rows, :corner] = spots[rows, max(width - corner, 0) :] = 0
    near = cv2.dilate(spots, np.ones((3, 3), np.uint8))
    mask[:] = near.repeat(2, axis=0).repeat(2, axis=1)
