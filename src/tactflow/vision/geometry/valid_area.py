"""Valid area: where a picture of the untouched gel shows gel.

Around the gel there may be a black housing, a vignette, a dark corner that the lens does not reach, or a lamp
that saturates the camera. A change there is not one of the gel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import SATURATED_GREY, Mask

BLACK_GREY: Final = 24
"""Grey levels below which a pixel is black: video has its black at 16 (ITU-R BT.601), and compression and
noise add to it; the gel below the white pins of tactip_video is 17. Chosen by hand."""
MAX_DARK_RATIO: Final = 0.15
"""Largest brightness of a dark place, relative to that of the brightest tenth of the picture. Chosen on the
development recordings: corners of a gel are above 0.2, visible housings below 0.12."""
BRIGHT_PERCENTILE: Final = 90.0
"""Percentile of the brightness that represents the brightest part of the picture. Chosen by hand."""
MIN_COARSE_SIDE_PX: Final = 200
"""Smallest shorter side of the examined picture, px; larger ones are shrunk by a whole factor. Chosen by
hand: 10 ms instead of 100 for each reference."""
SMOOTHING_SIDE_PX: Final = 5
"""Side of the square over which brightness is averaged, px of that picture. Chosen by hand."""
MIN_RADIUS_SHARE: Final = 0.05
"""Smallest radius of a disc that fits into a place without gel, over the shorter side of the picture. Smaller
places are marks, or the gaps between bright ones. Chosen by hand: the largest marks of the development
recordings have 0.04."""
MAX_EDGE_GREY: Final = 85.0
"""Largest change of the light along one direction across a place of gel, a square whose side is twice that
radius, grey levels. The gel under the contacts of 13 labs has at most 78; the folds, lamps and housings
around two gels in jars have 180 and more (measured)."""
SURROUND_RADIUS_SIDES: Final = 1.2
"""Smallest radius of surroundings full of edges, in sides of that square. One edge is felt within 0.5 of it;
with 0.8, contacts beside the border of a gel are cut off (wedge_grasp)."""
MIN_LIT_SURROUNDINGS_SHARE: Final = 0.5
"""Smallest share of the surroundings of a place that is not black where the light counts. Derived: marks
cover less than half."""


def valid_area(image: NDArray[np.uint8]) -> Mask:
    """Where the picture of an untouched gel shows gel: neither black nor saturated over some width.

    Beyond the border of the picture there is no gel, so that a dark strip along the border is found however
    thin it is, while a mark that the border cuts stays gel. Where brightness shows no gel at all, the whole
    picture is valid.

    image : (H, W, 3) or (H, W) uint8, grey levels. Returns (H, W) uint8, 255 where there is gel, else 0.
    Raises ValueError for another array.

    >>> picture = np.full((60, 80, 3), 120, np.uint8)
    >>> bool(valid_area(picture).all())
    True
    >>> picture[:, :20] = 8
    >>> valid_area(picture)[30, [10, 40]].tolist()
    [0, 255]
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"required an image of uint8, got shape {image.shape} {image.dtype}")
    height, width = image.shape[:2]
    factor = max(1, min(height, width) // MIN_COARSE_SIDE_PX)
    size = (math.ceil(width / factor), math.ceil(height / factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    smooth = np.atleast_3d(cv2.blur(small, (SMOOTHING_SIDE_PX, SMOOTHING_SIDE_PX)))
    brightness = smooth.max(axis=2)
    dark = brightness < max(BLACK_GREY, MAX_DARK_RATIO * float(np.percentile(brightness, BRIGHT_PERCENTILE)))
    without = _opened(dark | (smooth.min(axis=2) >= SATURATED_GREY), MIN_RADIUS_SHARE * min(size))
    if without.all() or not without.any():
        return np.full((height, width), 255, np.uint8)
    valid = np.where(without, 0, 255).astype(np.uint8)
    return np.asarray(cv2.resize(valid, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def lit_area(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where a gel without its marks has light that can change: most of the surroundings are not black, and
    they are not full of edges.

    On a black gel with white pins there is none, although a pin that was not removed is bright. Marks cover
    less than half of a place. The light on a gel changes smoothly, while housings, lamps and cloth around it
    have edges, which change with every shake of the camera; a single edge, such as the border of the gel,
    does not count.

    image : (H, W, 3) uint8, grey levels, without markers. Returns (H, W) bool.

    >>> gel = np.full((60, 80, 3), 120, np.uint8)
    >>> bool(lit_area(gel).all()), bool(lit_area(gel // 10).any())
    (True, False)
    """
    lit = (image.max(axis=2) >= BLACK_GREY).astype(np.float32)
    side = 2 * math.ceil(MIN_RADIUS_SHARE * min(lit.shape)) + 1
    edges = side * _oriented_slope(image, side) > MAX_EDGE_GREY
    around = _opened(edges, SURROUND_RADIUS_SIDES * side)
    return np.asarray((cv2.blur(lit, (side, side)) >= MIN_LIT_SURROUNDINGS_SHARE) & ~around)


def _oriented_slope(image: NDArray[np.uint8], side: int) -> NDArray[np.float32]:
    """(H, W) float32, grey levels per px: how much the RMS slope of the light within a square exceeds that
    across it, by the structure tensor; the largest of the channels.

    Across an edge or a fold it is steep, along it even; a dot is as steep in all directions.

    References
    ----------
    Bigün and Granlund, "Optimal orientation detection of linear symmetry", ICCV (1987).
    """
    smooth = cv2.blur(image, (3, 3)).astype(np.float32)
    right, down = (cv2.Sobel(smooth, -1, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    difference, mixed = (cv2.blur(a, (side, side)) for a in (right**2 - down**2, 2 * right * down))
    return np.asarray(np.sqrt(np.atleast_3d(np.hypot(difference, mixed)).max(axis=2)), np.float32)


def polygon_mask(polygon: Sequence[Sequence[float]], width: int, height: int) -> Mask:
    """The area inside a polygon.

    polygon : corners (x, y) in order, px, three at least. width, height : of the picture, px.
    Returns (height, width) uint8, 255 inside and on the border. Raises ValueError for fewer corners, or if no
    pixel is inside.

    >>> polygon_mask([(1, 1), (3, 1), (3, 2), (1, 2)], width=5, height=4)[:, 2].tolist()
    [0, 255, 255, 0]
    """
    corners = np.array(polygon, np.float64).reshape(-1, 2)
    if len(corners) < 3:
        raise ValueError(f"required a polygon of at least 3 corners, got {len(corners)}")
    area = np.zeros((height, width), np.uint8)
    cv2.fillPoly(area, [np.rint(corners).astype(np.int32)], 255)
    if not area.any():
        raise ValueError(f"the polygon covers no pixel of the {width} x {height} picture")
    return area


def bounding_box(valid: Mask) -> tuple[slice, slice]:
    """Rows and columns of the bounding box of an area, (H, W) uint8, which is not empty.

    >>> bounding_box(polygon_mask([(1, 1), (3, 1), (3, 2), (1, 2)], width=5, height=4))
    (slice(1, 3, None), slice(1, 4, None))
    """
    left, top, width, height = cv2.boundingRect(valid)
    return slice(top, top + height), slice(left, left + width)


def _opened(region: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Morphological opening of a region by a disc; all beyond the border belongs to the region.

    Two distance transforms take the same time for any radius.
    """
    if not region.any():
        return region
    # A margin of two radii is all that reaches into the picture.
    margin = int(np.ceil(2 * radius)) + 2
    wide = np.pad(region, margin, constant_values=True).astype(np.uint8)
    inside = cv2.distanceTransform(wide, cv2.DIST_L2, cv2.DIST_MASK_5)
    outside_centers = (inside <= radius).astype(np.uint8)
    covered = cv2.distanceTransform(outside_centers, cv2.DIST_L2, cv2.DIST_MASK_5) <= radius
    cut = slice(margin, -margin)
    return np.asarray(region & covered[cut, cut])
