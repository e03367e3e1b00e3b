"""Shape of the contact region: hull, centroid, principal direction, ellipse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.direction import anisotropy_limit, axis_direction
from tactflow.vision.geometry.moments import Box, Moments, region_moments
from tactflow.vision.types import Contact, Ellipse, Evidence, Outlines

Contours = Sequence[NDArray[Any]]

_FEWEST_PIXELS: Final = 5
"""Pixels that a region needs for an ellipse. Derived: an ellipse has five parameters."""
_WIDTH_OF_A_LINE: Final = 1 / 12 + 1e-9
"""Variance across a region, px^2, up to which it has no ellipse. Derived: a straight line of pixels has up to
1/12; the rest is for rounding."""


def contact_geometry(
    mask: NDArray[np.uint8] | Outlines,
    *,
    min_area: float = 1.0,
    max_gap: float | None = None,
    min_confidence: float = 0.0,
) -> Contact | None:
    """Describe the contact region of a mask; None where there is none.

    mask : (H, W) uint8, non-zero inside the contact; or its outlines, where they are known.
    min_area : px^2; components (8-connected, holes filled) with fewer pixels are ignored. Larger is safer
        against specks and misses small contacts.
    max_gap : px; components whose nearest pixels are at most this far apart (to within 1 px and 2 %) belong
        together, also by way of others; the group with the most pixels is the contact. None: all components
        are one contact.
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
    outlines = _outlines(mask, min_area, max_gap, min_confidence)
    seen = _components(outlines, min_area)
    if seen is None:
        return None
    if max_gap is not None and len(seen.contours) > 1:
        groups = _groups(seen.contours, seen.box, max_gap)
        seen = _part(seen, max(groups, key=_pixels)) if len(groups) > 1 else seen
    return _describe(seen, min_confidence)


def contact_parts(
    mask: NDArray[np.uint8] | Outlines,
    *,
    min_area: float = 1.0,
    max_gap: float = 0.0,
    min_confidence: float = 0.0,
    evidence: Evidence = "light",
) -> list[Contact]:
    """Describe each separate contact region of a mask, the one with the most pixels first.

    evidence : what shows them. The other parameters and what is raised are those of `contact_geometry`, which
    describes one of these contacts, or all of them as one.

    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = mask[50:55, 10:20] = 255
    >>> [contact.region_area for contact in contact_parts(mask)]
    [400.0, 50.0]
    """
    outlines = _outlines(mask, min_area, max_gap, min_confidence)
    seen = _components(outlines, min_area)
    if seen is None:
        return []
    groups = _groups(seen.contours, seen.box, max_gap) if len(seen.contours) > 1 else [seen.contours]
    if len(groups) == 1:
        return [_describe(seen, min_confidence, evidence)]
    ordered = sorted(groups, key=_pixels, reverse=True)
    return [_describe(_part(seen, group), min_confidence, evidence) for group in ordered]


class _Seen(NamedTuple):
    """Components of a mask. roi : the mask inside `box`. contours : their outlines, in pixels of the mask.

    moments : of their pixels, relative to the corner of the box.
    """

    roi: NDArray[Any]
    box: Box
    contours: Contours
    moments: Moments


def _components(outlines: Outlines, min_area: float) -> _Seen | None:
    """The components of a mask that are large enough; None where there is none."""
    mask, contours = outlines
    if not contours:
        return None
    box, moments = region_moments(mask)
    seen = _Seen(
        mask[box.top : box.top + box.height, box.left : box.left + box.width], box, contours, moments
    )
    if len(contours) > 1 or moments.pixels < min_area:
        kept = [contour for contour in contours if _filled_area(contour) >= min_area]
        if not kept:
            return None
        if len(kept) < len(contours):
            seen = _part(seen, kept)
    return seen


def _part(seen: _Seen, contours: Contours) -> _Seen:
    """Some of the components."""
    return seen._replace(contours=contours, moments=_moments_inside(seen.roi, contours, seen.box))


def _outlines(
    mask: NDArray[np.uint8] | Outlines, min_area: float, max_gap: float | None, min_confidence: float
) -> Outlines:
    """Those of a mask; ValueError if anything is out of its range."""
    if not (min_area >= 0 and math.isfinite(min_area)):
        raise ValueError(f"required min_area >= 0 px^2, got {min_area}")
    if max_gap is not None and not max_gap >= 0:
        raise ValueError(f"required max_gap >= 0 px or None, got {max_gap}")
    if not 0 <= min_confidence <= 1:
        raise ValueError(f"required min_confidence in [0, 1], got {min_confidence}")
    if isinstance(mask, Outlines):
        return mask
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    return Outlines.of(mask) if mask.size else Outlines(mask, ())


def _describe(seen: _Seen, min_confidence: float, evidence: Evidence = "light") -> Contact:
    """The contact that these components are together."""
    _, box, contours, moments = seen
    outline = contours[0] if len(contours) == 1 else np.concatenate(contours)
    polygon = cv2.convexHull(outline)
    # Whole numbers: no cancellation, a vertical bar is exactly vertical.
    xx, xy, yy = moments.central()
    count = moments.pixels
    spread = math.hypot(xx - yy, 2 * xy)
    square = float(count) * count
    major = (xx + yy + spread) / (2 * square)
    minor = (xx * yy - xy * xy) / (square * square * major) if major > 0 else 0.0
    confidence = min(1.0, spread / (xx + yy)) if xx + yy > 0 else 0.0
    center = (moments.x / count + box.left, moments.y / count + box.top)
    angle = slope = None
    if confidence > min_confidence and confidence > anisotropy_limit(
        contours, count, center, (xx, xy, yy), confidence
    ):
        angle, slope = axis_direction(0.5 * math.atan2(2 * xy, xx - yy))
    ellipse = None
    if count >= _FEWEST_PIXELS and minor > _WIDTH_OF_A_LINE:
        ellipse = Ellipse(center, (4 * math.sqrt(major), 4 * math.sqrt(minor)), angle)
    return Contact(
        area=_pixels_in_hull(polygon),
        center=center,
        angle=angle,
        slope=slope,
        hull=polygon[:, 0].astype(np.float64),
        ellipse=ellipse,
        confidence=confidence,
        region_area=float(count),
        evidence=evidence,
    )


def _moments_inside(roi: NDArray[Any], contours: Contours, box: Box) -> Moments:
    """Moments of those pixels in the box that the outlines enclose, relative to its corner."""
    left, top, wide, high = cv2.boundingRect(contours[0] if len(contours) == 1 else np.concatenate(contours))
    filled = np.zeros((high, wide), np.uint8)
    cv2.drawContours(filled, contours, -1, 255, cv2.FILLED, offset=(-left, -top))
    left, top = left - box.left, top - box.top
    seen = cv2.bitwise_and(roi[top : top + high, left : left + wide], filled)
    inside, moments = region_moments(np.asarray(seen, np.uint8))
    return moments.moved(left + inside.left, top + inside.top)


def _filled_area(contour: NDArray[Any]) -> float:
    """Pixels of a component from its outline of pixel centres, holes filled (Pick's theorem)."""
    return cv2.contourArea(contour) + len(contour) / 2 + 1 if len(contour) > 1 else 1.0


def _pixels_in_hull(polygon: NDArray[Any]) -> float:
    """Grid points in or on a polygon (n, 1, 2) of grid points (Pick's theorem); exact."""
    # Of a few vertices, numbers are quicker than arrays.
    places: list[list[int]] = polygon[:, 0].tolist()
    twice = on_border = 0
    x, y = places[-1]
    for next_x, next_y in places:
        twice += x * next_y - next_x * y
        on_border += math.gcd(next_x - x, next_y - y)
        x, y = next_x, next_y
    return (abs(twice) + on_border) / 2 + 1


def _pixels(contours: Contours) -> float:
    """Pixels of some components, holes filled."""
    return sum(map(_filled_area, contours))


def _groups(contours: Contours, box: Box, max_gap: float) -> list[Contours]:
    """The contours in groups that are linked by gaps of at most max_gap px.

    box : the window that holds them.
    """
    if max_gap == 0:
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
