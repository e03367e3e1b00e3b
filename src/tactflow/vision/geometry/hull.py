"""Shape of the contact region: hull, centroid, principal direction, ellipse."""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Mask, Numbers, Points, check_mask
from tactflow.vision.compiled import kernel
from tactflow.vision.geometry.direction import anisotropy_limit, axis_direction
from tactflow.vision.geometry.region import Contours, Region, measure_region
from tactflow.vision.types import Contact, Ellipse, Evidence

_MIN_ELLIPSE_PIXELS: Final = 5
"""Smallest number of pixels with an ellipse. Derived: an ellipse has five parameters."""
_MAX_LINE_VARIANCE_PX2: Final = 1 / 12 + 1e-9
"""Variance across a region, px^2, up to which it has no ellipse. Derived: that of a straight line of pixels
is at most 1/12; the rest is for rounding."""


def contact_geometry(
    mask: Mask, *, min_area: float = 1.0, min_confidence: float = 0.0, core: Mask | None = None
) -> Contact | None:
    """Describe the contact region of a mask, all its components as one contact.

    Parameters
    ----------
    mask : (H, W) uint8, not 0 inside the contact.
    min_area : px^2; components (8-connected, holes filled) with fewer pixels are ignored. Larger is safer
        against specks and misses small contacts.
    min_confidence : 0 to 1; a region whose confidence is not above it gets no direction: 0.3 is an axis ratio
        of 1.36. Light from one side lengthens a mask in a way that its outline cannot distinguish from shape.
        Higher withholds the direction of stubby shapes.
    core : (H, W) uint8, not 0 where the gel clings to the object; None where that is not known.

    Returns
    -------
    Contact or None, where nothing is large enough. `area` counts the pixels whose centre lies in or on the
        hull (Pick's theorem): for a convex region its number of pixels. The direction and the ellipse are
        those of the second central moments; the direction is None where the anisotropy may be due to chance
        (see `tactflow.vision.geometry.direction`), the ellipse where the region is no wider than a pixel or
        has fewer than five. `confidence` is (l1 - l2) / (l1 + l2) of the principal variances l1 >= l2: 0 for
        a disc, 0.6 for an ellipse of axis ratio 2, 1 for a line.

    Raises
    ------
    ValueError : a mask is not (H, W) uint8, or a parameter is out of its range.

    Examples
    --------
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> contact = contact_geometry(mask)
    >>> contact.center, contact.area, contact.angle
    ((29.5, 24.5), 400.0, 0.0)
    """
    region, contours = _large_regions(mask, min_area, min_confidence, core)
    return _describe(region, contours, min_confidence, core=core) if contours else None


def contact_parts(
    mask: Mask,
    *,
    min_area: float = 1.0,
    min_confidence: float = 0.0,
    evidence: Evidence = "light",
    core: Mask | None = None,
) -> list[Contact]:
    """Describe each separate contact region of a mask, the one with the most pixels first.

    evidence : what shows the contacts. The other parameters and errors are those of `contact_geometry`,
    which describes all regions as one contact.

    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = mask[50:55, 10:20] = 255
    >>> [contact.region_area for contact in contact_parts(mask)]
    [400.0, 50.0]
    """
    region, contours = _large_regions(mask, min_area, min_confidence, core)
    parts = []
    for contour in sorted(contours, key=_filled_area, reverse=True):
        part = region if len(contours) == 1 else _only(mask, [contour])
        parts.append(_describe(part, [contour], min_confidence, evidence, core))
    return parts


def large_contours(mask: Mask, min_area: float) -> list[NDArray[Any]]:
    """Outer outlines of the components of a mask (8-connected) with at least so many pixels, holes filled.

    mask : (H, W) uint8, not 0 inside the contact. min_area : px^2, >= 0. Each outline is (n, 1, 2) int32, px.

    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = mask[50:55, 10:20] = 255
    >>> len(large_contours(mask, 1)), len(large_contours(mask, 100))
    (2, 1)
    """
    check_mask(mask)
    return [contour for contour in measure_region(mask).contours() if _filled_area(contour) >= min_area]


def contact_of_outline(
    contours: Contours,
    center: tuple[float, float],
    theta: float | None,
    confidence: float,
    region_area: float,
) -> Contact:
    """A contact with the hull of its outlines, and with centre and direction as given; it has no ellipse.

    contours : of `large_contours`, at least one. center : (x, y), px. theta : of its axis, radians, from +x
    towards +y (y down); None for no direction. confidence : of the direction, 0 to 1. region_area : px^2.

    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> contact_of_outline(large_contours(mask, 1), (29.5, 24.5), 0.0, 0.9, 400.0).area
    400.0
    """
    angle, slope = (None, None) if theta is None else axis_direction(theta)
    polygon, area = _hull(contours)
    return Contact(area, center, angle, slope, polygon, None, confidence, region_area)


def _large_regions(
    mask: Mask, min_area: float, min_confidence: float, core: Mask | None
) -> tuple[Region, Contours]:
    """The components of a mask that are large enough, and their outlines.

    Raises ValueError if anything is out of its range.
    """
    if not (min_area >= 0 and math.isfinite(min_area)):
        raise ValueError(f"required min_area >= 0 px^2, got {min_area}")
    if not 0 <= min_confidence <= 1:
        raise ValueError(f"required min_confidence in [0, 1], got {min_confidence}")
    check_mask(mask)
    if core is not None:
        check_mask(core, mask.shape, "core")
    region = measure_region(mask)
    contours = region.contours()
    large = [contour for contour in contours if _filled_area(contour) >= min_area]
    return region if len(large) == len(contours) else _only(mask, large), large


def _only(mask: Mask, contours: Contours) -> Region:
    """Some components of a mask."""
    only = np.zeros_like(mask)
    cv2.drawContours(only, contours, -1, 255, cv2.FILLED)
    return measure_region(only & mask)


def _describe(
    region: Region,
    contours: Contours,
    min_confidence: float,
    evidence: Evidence = "light",
    core: Mask | None = None,
) -> Contact:
    """The contact that a region is."""
    moments = region.moments()
    _, _, xx, xy, yy = moments
    major, minor = moments.principal
    confidence = min(1.0, moments.spread / (xx + yy)) if xx + yy > 0 else 0.0
    angle = slope = None
    if confidence > min_confidence and confidence > anisotropy_limit(
        contours, moments, region.pixels, confidence
    ):
        angle, slope = axis_direction(0.5 * math.atan2(2 * xy, xx - yy))
    center, ellipse = moments[:2], None
    if region.pixels >= _MIN_ELLIPSE_PIXELS and minor > _MAX_LINE_VARIANCE_PX2:
        ellipse = Ellipse(center, (4 * math.sqrt(major), 4 * math.sqrt(minor)), angle)
    polygon, area = _hull(contours)
    return Contact(
        area,
        center,
        angle,
        slope,
        polygon,
        ellipse,
        confidence,
        region_area=float(region.pixels),
        evidence=evidence,
        core_area=None if core is None else _core_area(core, region),
    )


def _core_area(core: Mask, region: Region) -> float | None:
    """Area of the convex hull of the core inside a region, px^2; None if there is none."""
    window = core[region.top : region.top + region.height, region.left : region.left + region.width]
    inside = cv2.bitwise_and(window, window, mask=region.window)
    ends = np.empty((2 * len(inside), 2), np.int32)
    count = row_ends(np.asarray(inside, np.uint8), ends)
    return convex_hull(ends[:count], np.empty_like(ends))[1] if count else None


def _hull(contours: Contours) -> tuple[Points, float]:
    """Convex hull of some components: its corners (m, 2), clockwise on the screen; pixels in it."""
    points = np.concatenate(contours)[:, 0]
    corners = np.empty_like(points)
    count, area = convex_hull(points, corners)
    return corners[: int(count)].astype(np.float64), area


@kernel
def row_ends(mask: Mask, ends: Numbers) -> int:
    """The first and the last pixel of each row that has any; returns their number.

    mask : (h, w), not 0 inside. ends : (2 h, 2), filled from its start.
    """
    rows = [(y, np.flatnonzero(row)) for y, row in enumerate(mask) if row.any()]
    points = [(x[at], y) for y, x in rows for at in (0, -1)]
    ends[: len(points)] = np.reshape(points, (-1, 2))
    return len(points)


@kernel
def convex_hull(points: Numbers, corners: Numbers) -> tuple[float, float]:
    """The number of corners of a convex hull, and of the pixels in it, by Pick's theorem.

    points : (n, 2), pixels, n >= 1. corners : (n, 2), filled from its start, clockwise on the screen.

    A. Andrew, "Another efficient algorithm for convex hulls in two dimensions", Information Processing
    Letters 9 (1979).
    """
    hull = cv2.convexHull(points)[:, 0]
    steps = hull - np.roll(hull, 1, axis=0)
    corners[: len(hull)] = hull
    return len(hull), cv2.contourArea(hull) + int(np.gcd(steps[:, 0], steps[:, 1]).sum()) / 2 + 1


def _filled_area(contour: NDArray[Any]) -> float:
    """Pixels of a component from its outline of pixel centres, holes filled (Pick's theorem)."""
    return cv2.contourArea(contour) + len(contour) / 2 + 1 if len(contour) > 1 else 1.0
