"""Geometry of the contact region: hull, centroid, principal direction, ellipse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.geometry import moments
from tactflow.vision.types import Contact, Ellipse

FALSE_DIRECTION: Final = 1e-3
"""Share of directionless regions that may be given a direction by chance."""

# Variance of the anisotropy of a disc of radius R on a pixel grid at random phase, along its stronger
# component: _GRID_NOISE / R^3. See `_anisotropy_limit`.
_GRID_NOISE: Final = 0.122
# Outline harmonics that measure how rough the outline is; 0 to 2 are size, place and elongation themselves.
_HARMONICS: Final = range(3, 10)
# Pixels from which on a region is summed by runs.
_LARGE: Final = 20_000
# Up to here (axis ratio 2) elongation is proportional to the outline's second harmonic.
_LINEAR_LIMIT: Final = 0.6


def contact_geometry(
    mask: NDArray[np.uint8],
    *,
    min_area: float = 1.0,
    max_gap: float | None = None,
    min_confidence: float = 0.0,
) -> Contact | None:
    """Describe the contact region of a mask; None where there is none.

    mask : (H, W) uint8, non-zero inside the contact.
    min_area : px^2; blobs (8-connected, holes filled) with fewer pixels are ignored. Larger is safer against
        specks and misses small contacts.
    max_gap : px; blobs whose nearest pixels are at most this far apart (to within 1 px and 2 %) belong
        together, also by way of others; the group with the most pixels is the contact. None: all blobs are
        one contact.
    min_confidence : 0 to 1; a region whose confidence is not above it gets no direction. For errors that the
        mask makes in one direction (light from one side), which no statistics of its outline can tell from
        shape; 0.3 is an axis ratio of 1.36. Higher withholds the direction of stubby shapes.

    area counts the pixels whose centre lies in or on the hull (Pick's theorem). For a convex region this is
    its number of pixels, so it carries no bias from the half pixel between the outermost centres and the
    region's true border; the polygon of the vertices, which are pixel centres, is smaller by about that
    border. The direction comes from second central moments, computed in whole numbers (exact); it is None
    where the anisotropy is no larger than the pixel grid and the outline's own roughness produce by chance
    in a directionless shape (false alarm rate `FALSE_DIRECTION`). The ellipse has the region's second
    moments (exact for an elliptical region); None where the region is no wider than one pixel or has fewer
    than five.

    confidence is (l1 - l2) / (l1 + l2) for the principal variances l1 >= l2: 0 for a disc, 0.6 for an ellipse
    of axis ratio 2, 1 for a line.

    Raises ValueError if mask is not (H, W) uint8, or for a parameter out of its range.
    """
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    if not (min_area >= 0 and math.isfinite(min_area)):
        raise ValueError(f"required min_area >= 0 px^2, got {min_area}")
    if max_gap is not None and not max_gap >= 0:
        raise ValueError(f"required max_gap >= 0 px or None, got {max_gap}")
    if not 0 <= min_confidence <= 1:
        raise ValueError(f"required min_confidence in [0, 1], got {min_confidence}")
    if mask.size == 0:
        return None
    (left, top, width, height), sums = _measured(mask)
    if width == 0:
        return None
    roi: NDArray[Any] = mask[top : top + height, left : left + width]
    contours: Sequence[NDArray[Any]]
    corner = (left, top)
    contours, _ = cv2.findContours(roi, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=corner)
    if len(contours) > 1 or sums[0] < min_area:
        kept = [contour for contour in contours if _filled_area(contour) >= min_area]
        if len(kept) > 1 and max_gap is not None:
            kept = _largest_group(kept, corner, roi.shape, max_gap)
        if not kept:
            return None
        if len(kept) < len(contours):
            filled = np.zeros(roi.shape, np.uint8)
            cv2.drawContours(filled, kept, -1, 255, cv2.FILLED, offset=(-left, -top))
            sums = _pixel_sums(cv2.bitwise_and(roi, roi, mask=filled))
        contours = kept
    outline = contours[0] if len(contours) == 1 else np.concatenate(contours)
    polygon = cv2.convexHull(outline)
    # Sums over pixels in whole numbers: no cancellation, a vertical bar is exactly vertical.
    count, sx, sy, sxx, sxy, syy = sums
    xx, xy, yy = count * sxx - sx * sx, count * sxy - sx * sy, count * syy - sy * sy
    spread = math.hypot(xx - yy, 2 * xy)
    square = float(count) * count
    major = (xx + yy + spread) / (2 * square)
    minor = (xx * yy - xy * xy) / (square * square * major) if major > 0 else 0.0
    confidence = min(1.0, spread / (xx + yy)) if xx + yy > 0 else 0.0
    center = (sx / count + left, sy / count + top)
    angle = slope = None
    if confidence > min_confidence and confidence > _anisotropy_limit(
        contours, count, center, (xx, xy, yy), confidence
    ):
        angle, slope = axis_direction(0.5 * math.atan2(2 * xy, xx - yy))
    ellipse = None
    # A straight line of pixels one pixel wide has a variance of up to 1/12 across.
    if count >= 5 and minor > 1 / 12 + 1e-9:
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
    )


def axis_direction(theta: float) -> tuple[float, float | None]:
    """Angle and slope of an axis.

    theta : direction of the axis, radians, from +x towards +y (y down).
    Returns (angle, slope): degrees in (-90, 90], counter-clockwise on the screen, and dy/dx (y down); the
    slope is None where the axis is vertical.

    >>> axis_direction(0.0)
    (0.0, 0.0)
    """
    angle = -math.degrees(theta)
    angle = angle - 180 * math.floor((angle + 90) / 180)
    if angle <= -90.0:
        angle += 180.0
    # Beyond 1e-7 rad from the vertical a slope is a number, within it the sign is down to rounding.
    slope = None if abs(abs(angle) - 90) < 6e-6 else math.tan(theta) + 0.0
    return angle + 0.0, slope


def _measured(mask: NDArray[np.uint8]) -> tuple[list[int], list[int]]:
    """Bounding box (left, top, width, height) of the non-zero pixels, and `_pixel_sums` inside of it."""
    if compiled.active():
        found = np.empty(10, np.int64)
        moments.measure_region(np.ascontiguousarray(mask), found)
        numbers: list[int] = found.tolist()
        return numbers[:4], numbers[4:]
    left, top, width, height = box = cv2.boundingRect(mask)
    return list(box), _pixel_sums(mask[top : top + height, left : left + width]) if width else []


def _pixel_sums(roi: NDArray[Any]) -> list[int]:
    """Over the non-zero pixels: their number and the sums of x, y, x^2, x y and y^2; exact."""
    if roi.size < _LARGE:
        moments = cv2.moments(roi, binaryImage=True)
        m00, m10, m01 = round(moments["m00"]), round(moments["m10"]), round(moments["m01"])
        return [m00, m10, m01, round(moments["m20"]), round(moments["m11"]), round(moments["m02"])]
    # By runs of pixels, of which a large region has few. Each line starts with a pixel outside.
    width = roi.shape[1] + 1
    inside = np.zeros((len(roi), width), np.bool_)
    np.not_equal(roi, 0, out=inside[:, 1:])
    flat = inside.ravel()
    ends = np.flatnonzero(flat[1:] != flat[:-1])
    if flat[-1]:
        ends = np.append(ends, flat.size - 1)
    before, last = ends[::2], ends[1::2]
    y = before // width
    first, length = before - y * width, last - before
    after = first + length
    x = (first + after - 1) * length // 2
    # The sum of the squares below n is (n - 1) n (2 n - 1) / 6.
    squares = ((after - 1) * after * (2 * after - 1) - (first - 1) * first * (2 * first - 1)) // 6
    lines = y * length
    return [
        int(length.sum()),
        int(x.sum()),
        int(lines.sum()),
        int(squares.sum()),
        int((y * x).sum()),
        int((y * lines).sum()),
    ]


def _filled_area(contour: NDArray[Any]) -> float:
    """Pixels of a blob from its outline of pixel centres, holes filled (Pick's theorem)."""
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


def _largest_group(
    contours: list[NDArray[Any]], corner: tuple[int, int], shape: tuple[int, ...], max_gap: float
) -> list[NDArray[Any]]:
    """The contours of the group with the most pixels; groups are linked by gaps of at most max_gap.

    corner, shape : of the window that holds them, (x, y) and (h, w) px.
    """
    reach = min(max_gap, float(sum(shape)))
    border = math.ceil(reach / 2) + 1
    left, top = corner[0] - border, corner[1] - border
    free = np.full((shape[0] + 2 * border, shape[1] + 2 * border), 255, np.uint8)
    cv2.drawContours(free, contours, -1, 0, cv2.FILLED, offset=(-left, -top))
    # Two blobs grown by half the gap each touch where the gap was bridged.
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)
    _, labels = cv2.connectedComponents((distance <= reach / 2).astype(np.uint8))
    sizes: dict[int, float] = {}
    names = []
    for contour in contours:
        x, y = contour[0, 0]
        name = int(labels[y - top, x - left])
        names.append(name)
        sizes[name] = sizes.get(name, 0.0) + _filled_area(contour)
    largest = max(sizes, key=lambda name: sizes[name])
    return [contour for contour, name in zip(contours, names, strict=True) if name == largest]


def _anisotropy_limit(
    contours: Sequence[NDArray[Any]],
    count: int,
    center: tuple[float, float],
    second: tuple[int, int, int],
    confidence: float,
) -> float:
    """Anisotropy that a directionless region reaches by chance in a share `FALSE_DIRECTION` of cases.

    Two causes. (1) The grid: for a disc of radius R whose centre lies anywhere in a pixel, the sum of
    x^2 - y^2 over its pixels varies by R^5 / (2 pi^2) times the sum of cos^2(2 phi_k) / |k|^3 over the
    reciprocal lattice (the argument by which Kendall, 1948, found the variance of the number of lattice
    points in an oval), 5.94 for this component and 3.08 for 2 x y. Relative to R^2 / 2 and the area, the
    anisotropy has variance 0.122 / R^3, and its length exceeds t with a probability of at most
    exp(-t^2 / (2 * 0.122 / R^3)). (2) The outline's roughness, as seen in the outline's deviation from the
    ellipse of its second moments: for noise shorter than the outline, the harmonics 2, 3, 4, ... have
    equal, exponentially distributed power, and an anisotropy c is 4 times the second harmonic. The median
    power of harmonics 3 to 9 estimates it; the median, because a polygon has a few strong harmonics and is
    not rough. For n = 7 exponential variables, the chance that an eighth exceeds t times their median is the
    product of j / (j + t) for j = 4 ... 7. The larger of the two limits counts.
    """
    radius = math.sqrt(count / math.pi)
    limit = math.sqrt(-2 * math.log(FALSE_DIRECTION) * _GRID_NOISE / radius**3)
    if confidence > _LINEAR_LIMIT or confidence <= limit:
        return limit
    xx, xy, yy = (value / (float(count) * count) for value in second)
    # Whitening by the Cholesky factor: in these coordinates the ellipse of second moments is a circle.
    l11 = math.sqrt(xx)
    l21 = xy / l11
    l22 = math.sqrt(max(yy - l21 * l21, 1e-12))
    deviations = []
    turns = []
    for contour in contours:
        z = np.empty(len(contour), np.complex128)
        z.real = (contour[:, 0, 0] - center[0]) / l11
        z.imag = (contour[:, 0, 1] - center[1] - l21 * z.real) / l22
        distance = np.maximum(np.abs(z), 1e-9)
        turn = z / distance
        # Share of the full turn that each outline point stands for.
        around = np.concatenate([turn[-1:], turn, turn[:1]])
        share = np.imag(np.conj(around[:-2]) * around[2:]) / (4 * math.pi)
        deviations.append((distance / 2 - 1) * share)
        turns.append(turn)
    turn = np.concatenate(turns)
    powers = np.empty((len(_HARMONICS), len(turn)), np.complex128)
    np.multiply(turn * turn, turn * np.concatenate(deviations), out=powers[0])
    for k in range(1, len(powers)):
        np.multiply(powers[k - 1], turn, out=powers[k])
    # Summed by numpy itself: a library of linear algebra would start threads for this.
    power = np.abs(powers.sum(axis=1)) ** 2
    rough = 4 * math.sqrt(_MEDIAN_RATIO * float(np.median(power)))
    return min(max(limit, rough), _LINEAR_LIMIT)


def _median_ratio(probability: float) -> float:
    """t with prod j / (j + t), j = 4 ... 7, equal to `probability`, by bisection."""
    low, high = 0.0, 1e6
    for _ in range(200):
        t = (low + high) / 2
        if math.prod(j / (j + t) for j in range(4, 8)) > probability:
            low = t
        else:
            high = t
    return low


_MEDIAN_RATIO: Final = _median_ratio(FALSE_DIRECTION)
