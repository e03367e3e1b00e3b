"""Shape of the contact region: hull, centroid, principal direction, ellipse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.direction import anisotropy_limit, axis_direction
from tactflow.vision.geometry.moments import Box, RegionProperties
from tactflow.vision.types import Contact, Ellipse, Evidence

Contours = Sequence[NDArray[Any]]

_FEWEST_PIXELS: Final = 5
"""Pixels that a region needs for an ellipse. Derived: an ellipse has five parameters."""
_WIDTH_OF_A_LINE: Final = 1 / 12 + 1e-9
"""Variance across a region, px^2, up to which it has no ellipse. Derived: a straight line of pixels has up to
1/12; the rest is for rounding."""


def contact_geometry(
    mask: NDArray[np.uint8] | RegionProperties,
    *,
    min_area: float = 1.0,
    min_confidence: float = 0.0,
) -> Contact | None:
    """Describe the contact region of a mask, all its components as one contact; None where there is none.

    mask : (H, W) uint8, non-zero inside the contact; or its properties, where they are known.
    min_area : px^2; components (8-connected, holes filled) with fewer pixels are ignored. Larger is safer
        against specks and misses small contacts.
    min_confidence : 0 to 1; a region whose confidence is not above it gets no direction. For errors that the
        mask makes in one direction (light from one side), which no statistics of its outline can tell from
        shape; 0.3 is an axis ratio of 1.36. Higher withholds the direction of stubby shapes.

    area counts the pixels whose centre lies in or on the hull (Pick's theorem). For a convex region this is
    its number of pixels, so it carries no bias from the half pixel between the outermost centres and the
    region's true border; the polygon of the vertices, which are pixel centres, is smaller by about that
    border. The direction comes from second central moments, computed in whole numbers (exact); it is None
    where the anisotropy is no larger than chance makes it (`tactflow.vision.geometry.direction`). The ellipse
    has the region's second moments (exact for an elliptical region); None where the region is no wider than
    one pixel or has fewer than five.

    confidence is (l1 - l2) / (l1 + l2) for the principal variances l1 >= l2: 0 for a disc, 0.6 for an ellipse
    of axis ratio 2, 1 for a line.

    Raises ValueError if mask is not (H, W) uint8, or for a parameter out of its range.

    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> contact = contact_geometry(mask)
    >>> contact.center, contact.area, contact.angle
    ((29.5, 24.5), 400.0, 0.0)
    """
    seen = _region(mask, min_area, min_confidence)
    return None if seen is None else _describe(seen, min_confidence)


def contact_parts(
    mask: NDArray[np.uint8] | RegionProperties,
    *,
    min_area: float = 1.0,
    max_gap: float = 0.0,
    min_confidence: float = 0.0,
    evidence: Evidence = "light",
) -> list[Contact]:
    """Describe each separate contact region of a mask, the one with the most pixels first.

    max_gap : px; components whose nearest pixels are at most this far apart (to within 1 px and 2 %) belong
        together, also by way of others.
    evidence : what shows them. The other parameters and what is raised are those of `contact_geometry`, which
    describes all of them as one.

    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = mask[50:55, 10:20] = 255
    >>> [contact.region_area for contact in contact_parts(mask)]
    [400.0, 50.0]
    """
    if not max_gap >= 0:
        raise ValueError(f"required max_gap >= 0 px, got {max_gap}")
    seen = _region(mask, min_area, min_confidence)
    if seen is None:
        return []
    if seen.connected:
        return [_describe(seen, min_confidence, evidence)]
    groups = sorted(_groups(seen.contours, seen.box, max_gap), key=_pixels, reverse=True)
    return [_describe(_only(seen, group), min_confidence, evidence) for group in groups]


def _region(
    mask: NDArray[np.uint8] | RegionProperties, min_area: float, min_confidence: float
) -> RegionProperties | None:
    """The regions of a mask that are large enough; None where there is none.

    Raises ValueError if anything is out of its range.
    """
    if not (min_area >= 0 and math.isfinite(min_area)):
        raise ValueError(f"required min_area >= 0 px^2, got {min_area}")
    if not 0 <= min_confidence <= 1:
        raise ValueError(f"required min_confidence in [0, 1], got {min_confidence}")
    if isinstance(mask, RegionProperties):
        region = mask
    elif mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    else:
        region = RegionProperties(mask)
    if region.connected and region.moments.pixels >= min_area:
        return region
    kept = [contour for contour in region.contours if _filled_area(contour) >= min_area]
    return _only(region, kept) if kept else None


def _only(region: RegionProperties, contours: Contours) -> RegionProperties:
    """Those regions that some of the contours are of, with what lies in their holes."""
    if len(contours) == len(region.contours):
        return region
    left, top, width, height = cv2.boundingRect(np.concatenate(contours))
    filled = np.zeros((height, width), np.uint8)
    cv2.drawContours(filled, contours, -1, 255, cv2.FILLED, offset=(-left, -top))
    x, y = left - region.corner[0], top - region.corner[1]
    seen = cv2.bitwise_and(region.mask[y : y + height, x : x + width], filled)
    return RegionProperties(np.asarray(seen, np.uint8), (left, top), contours)


def _describe(seen: RegionProperties, min_confidence: float, evidence: Evidence = "light") -> Contact:
    """The contact that these regions are together."""
    polygon, area = seen.hull()
    # Whole numbers: no cancellation, a vertical bar is exactly vertical.
    moments = seen.moments
    xx, xy, yy = moments.central()
    count = moments.pixels
    spread = math.hypot(xx - yy, 2 * xy)
    square = float(count) * count
    major = (xx + yy + spread) / (2 * square)
    minor = (xx * yy - xy * xy) / (square * square * major) if major > 0 else 0.0
    confidence = min(1.0, spread / (xx + yy)) if xx + yy > 0 else 0.0
    center = (moments.x / count + seen.box.left, moments.y / count + seen.box.top)
    angle = slope = None
    if confidence > min_confidence and confidence > anisotropy_limit(seen, confidence):
        angle, slope = axis_direction(0.5 * math.atan2(2 * xy, xx - yy))
    ellipse = None
    if count >= _FEWEST_PIXELS and minor > _WIDTH_OF_A_LINE:
        ellipse = Ellipse(center, (4 * math.sqrt(major), 4 * math.sqrt(minor)), angle)
    return Contact(area, center, angle, slope, polygon, ellipse, confidence, float(count), evidence)


def _filled_area(contour: NDArray[Any]) -> float:
    """Pixels of a component from its outline of pixel centres, holes filled (Pick's theorem)."""
    return cv2.contourArea(contour) + len(contour) / 2 + 1 if len(contour) > 1 else 1.0


def _pixels(contours: Contours) -> float:
    """Pixels of some components, holes filled."""
    return sum(map(_filled_area, contours))


def _groups(contours: Contours, box: Box, max_gap: float) -> list[Contours]:
    """The contours in groups that are linked by gaps of at most max_gap px.

    box : the window that holds them.
    """
    if max_gap == 0 or len(contours) == 1:
        return [[contour] for contour in contours]
    reach = min(max_gap, float(box.height + box.width))
    border = math.ceil(reach / 2) + 1
    left, top = box.left - border, box.top - border
    free = np.full((box.height + 2 * border, box.width + 2 * border), 255, np.uint8)
    cv2.drawContours(free, contours, -1, 0, cv2.FILLED, offset=(-left, -top))
    # Two components grown by half the gap each touch where the gap was bridged.
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)
    _, labels = cv2.connectedComponents((distance <= reach / 2).astype(np.uint8))
    groups: dict[int, list[NDArray[Any]]] = {}
    for contour in contours:
        x, y = contour[0, 0]
        groups.setdefault(int(labels[y - top, x - left]), []).append(contour)
    return list(groups.values())
