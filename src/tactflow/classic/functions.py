"""The functions of the original script, step by step and under their original names.

They are the yardstick for time and error. Three of the script's functions need no version of their own:
`get_processed_frame` is the stage `preprocess` with `method: pyramid`, and `draw_flow` and the drawing part
of `draw_flow_mask` are the stage `visualize`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.direction import axis_direction
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.types import Contact, Ellipse, Flow, Markers

MASK_THRESHOLD: Final = 120
"""Amplified difference of Gaussians above which a channel votes for a marker, grey levels; the script's."""

MARKER_AREAS: Final = (50.0, 500.0)
"""Areas between which a contour is a marker, px^2; chosen by hand for markers of 9 px diameter."""

INPAINT_RADIUS: Final = 7.0
"""Inpainting radius, px; the script's."""

BRIGHTER_BY: Final = 14
"""Smallest brightening, grey levels, that the script's threshold of 140 lets through; derived from it."""

_THINNEST_AXIS: Final = 1e-3
"""Length, px, below which `cv2.fitEllipse` has fitted a line; chosen by hand."""

_FIVE = np.ones((5, 5), np.uint8)
_NINE = np.ones((9, 9), np.uint8)
"""Squares of 5 and 9 px, with which the script erodes and dilates."""


@dataclass(frozen=True, slots=True)
class Line:
    """A regression line.

    angle : degrees in (-90, 90], counter-clockwise on the screen.
    slope : dy/dx (y down), -tan(angle); None where vertical.
    midpoint : (x, y), px, middle of the line between the left and the right edge of the picture; a point on
        the line where it is vertical.
    """

    angle: float
    slope: float | None
    midpoint: tuple[float, float]


def mask_marker(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mask of dark markers, by a difference of Gaussians.

    The frame is halved, blurred with Gaussians of 25 and 15 px, their difference is amplified 20 times and
    clipped, each channel votes where it exceeds 120, and two votes of three make a marker. The mask is
    enlarged with OpenCV's default interpolation, which carries a half-pixel shift.

    Parameters
    ----------
    frame : (H, W, 3) uint8, BGR grey levels.

    Returns
    -------
    mask : (H, W) uint8, 255 on markers, else 0. Computed in float32, as in the script; float64 would move its
        border by at most 1 px.

    Raises
    ------
    ValueError : if the frame is not of that kind.

    Examples
    --------
    >>> import numpy as np
    >>> mask_marker(np.full((40, 60, 3), 150, np.uint8)).any()
    np.False_
    """
    _require_bgr(frame, "frame")
    height, width = frame.shape[:2]
    small = cv2.pyrDown(np.ascontiguousarray(frame)).astype(np.float32)
    blur = cv2.GaussianBlur(small, (25, 25), 0)
    blur2 = cv2.GaussianBlur(small, (15, 15), 0)
    amplified = np.clip((blur - blur2) * np.float32(20), 0, 255)
    blue, green, red = (amplified[..., channel] > MASK_THRESHOLD for channel in range(3))
    votes = (blue & green) | (blue & red) | (green & red)
    enlarged = cv2.resize(votes.astype(np.uint8), (width, height))
    return np.asarray(enlarged * np.uint8(255), np.uint8)


def marker_center(
    frame: NDArray[np.uint8], *, least_area: float = MARKER_AREAS[0], most_area: float = MARKER_AREAS[1]
) -> NDArray[np.float64]:
    """Centres of the markers by contour moments, in the order in which OpenCV finds the contours.

    A contour counts if its area lies strictly between the limits and the longer side of its bounding box is
    less than twice the shorter one.

    Parameters
    ----------
    frame : (H, W, 3) uint8, BGR grey levels.
    least_area, most_area : px^2.

    Returns
    -------
    centers : (N, 2) float64, px, with the half-pixel shift of `mask_marker`.

    Raises
    ------
    ValueError : if the frame is not of that kind.

    Examples
    --------
    >>> import numpy as np
    >>> marker_center(np.full((40, 60, 3), 150, np.uint8)).shape
    (0, 2)
    """
    contours, _ = cv2.findContours(mask_marker(frame), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    centers = []
    for contour in contours:
        if not least_area < cv2.contourArea(contour) < most_area:
            continue
        _, _, width, height = cv2.boundingRect(contour)
        if max(width, height) < 2 * min(width, height):
            moments = cv2.moments(contour)
            centers.append((moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]))
    return np.array(centers, np.float64).reshape(-1, 2)


def inpaint(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The frame without its markers, filled from their borders by Telea's method.

    Parameters
    ----------
    frame : (H, W, 3) uint8, BGR grey levels.

    Returns
    -------
    unmarked : (H, W, 3) uint8, a new array; equal to the frame where `mask_marker` is 0.

    Raises
    ------
    ValueError : if the frame is not of that kind.

    References
    ----------
    A. Telea, "An image inpainting technique based on the fast marching method", 2004.

    Examples
    --------
    >>> import numpy as np
    >>> gel = np.full((40, 60, 3), 150, np.uint8)
    >>> np.array_equal(inpaint(gel), gel)
    True
    """
    return remove_markers(frame, mask_marker(frame), method="telea", radius=INPAINT_RADIUS)


def difference(
    frame: NDArray[np.uint8], frame0: NDArray[np.uint8], *, normalized_lb: float = 0.5, scale: float = 0.7
) -> NDArray[np.uint8]:
    """Contact mask, literally as in the script: where the gel is brighter in all channels.

    Slow; `contact_mask` gives the same mask in integer arithmetic. Values outside 0..255 are clipped before
    they become uint8 (converting them unclipped is undefined, and differs between processors).

    Parameters
    ----------
    frame : (H, W, 3) uint8, the frame without markers, BGR grey levels.
    frame0 : same shape, the untouched gel without markers.
    normalized_lb : value that stands for "no change" in the normalised difference, 0..1.
    scale : factor on negative differences, 0..1; it changes nothing after the threshold of 140.

    Returns
    -------
    mask : (H, W) uint8, 255 in contact, else 0.

    Raises
    ------
    ValueError : if the two are not images of the same size.

    Examples
    --------
    >>> import numpy as np
    >>> gel = np.full((40, 60, 3), 100, np.uint8)
    >>> difference(gel + np.uint8(14), gel).all(), difference(gel + np.uint8(13), gel).any()
    (np.True_, np.False_)
    """
    _require_pair(frame, frame0)
    diff = (frame * 1.0 - frame0) / 255.0 + normalized_lb
    below = diff < normalized_lb
    diff[below] = (diff[below] - normalized_lb) * scale + normalized_lb
    levels = np.clip(diff * 255, 0, 255).astype(np.uint8)
    levels[levels > 140] = 255
    levels[levels <= 140] = 0
    blue, green, red = cv2.split(levels)
    # A channel dominates where it exceeds another one; what no channel dominates is grey: contact.
    dominated = (blue > green) | (blue > red) | (green > blue) | (green > red) | (red > blue) | (red > green)
    neutral = np.where(dominated, 0, 255).astype(np.uint8)
    gray = cv2.cvtColor(cv2.bitwise_and(levels, levels, mask=neutral), cv2.COLOR_BGR2GRAY)
    _, binary = cv2.threshold(gray, 50, 255, cv2.THRESH_BINARY)
    eroded = cv2.erode(binary, _FIVE, iterations=2)
    return np.asarray(cv2.dilate(eroded, _FIVE, iterations=1), np.uint8)


def contact_mask(frame: NDArray[np.uint8], frame0: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Contact mask of `difference`, bit for bit, in saturating integer arithmetic.

    The script's chain of floating-point steps says: brighter by at least 14 grey levels in all three
    channels, then eroded twice and dilated once by 5 x 5. That is what is computed; two erosions by 5 x 5
    are one by 9 x 9.

    Parameters
    ----------
    frame : (H, W, 3) uint8, the frame without markers, BGR grey levels.
    frame0 : same shape, the untouched gel without markers.

    Returns
    -------
    mask : (H, W) uint8, 255 in contact, else 0.

    Raises
    ------
    ValueError : if the two are not images of the same size.

    Examples
    --------
    >>> import numpy as np
    >>> gel = np.full((40, 60, 3), 100, np.uint8)
    >>> contact_mask(gel + np.uint8(14), gel).all()
    np.True_
    """
    _require_pair(frame, frame0)
    brighter = cv2.subtract(frame, frame0)
    floor = (BRIGHTER_BY,) * 3
    binary = cv2.inRange(brighter, floor, (255,) * 3)
    return np.asarray(cv2.dilate(cv2.erode(binary, _NINE), _FIVE), np.uint8)


def get_all_contour(mask: NDArray[np.uint8]) -> NDArray[np.int32]:
    """The points of all outer contours of a mask, one after another.

    Parameters
    ----------
    mask : (H, W) uint8, non-zero in contact.

    Returns
    -------
    points : (N, 1, 2) int32, px; N is 0 for an empty mask.

    Raises
    ------
    ValueError : if the mask is not of that kind.

    Examples
    --------
    >>> import numpy as np
    >>> mask = np.zeros((40, 60), np.uint8)
    >>> mask[10:20, 15:46] = 255
    >>> get_all_contour(mask).shape
    (78, 1, 2)
    """
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    left, top, width, height = cv2.boundingRect(mask) if mask.size else (0, 0, 0, 0)
    if width == 0:
        return np.empty((0, 1, 2), np.int32)
    inside: NDArray[Any] = mask[top : top + height, left : left + width]
    contours, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(left, top))
    return np.asarray(np.vstack(contours), np.int32)


def fit_ellipse(points: NDArray[np.int32]) -> Ellipse | None:
    """The ellipse that the script fits to the points of `get_all_contour`.

    Parameters
    ----------
    points : (N, 1, 2) int32, px.

    Returns
    -------
    ellipse : by `cv2.fitEllipse`; None where that fails, for fewer than five points, and for a line.

    Examples
    --------
    >>> import numpy as np
    >>> mask = cv2.ellipse(np.zeros((80, 120), np.uint8), (60, 40), (30, 15), 0, 0, 360, 255, -1)
    >>> [round(length) for length in fit_ellipse(get_all_contour(mask)).axes]
    [60, 30]
    """
    if len(points) < 5:
        return None
    # OpenCV fits in single precision: relative to the contact, its place in the frame costs nothing.
    left, top = points.min(axis=(0, 1)).tolist()
    try:
        (x, y), (first, second), turned = cv2.fitEllipse(points - np.array([left, top], np.int32))
    except cv2.error:
        return None
    if not np.isfinite([x, y, first, second, turned]).all() or min(first, second) <= _THINNEST_AXIS:
        return None
    # OpenCV measures the angle of the first axis, clockwise on the screen.
    theta = math.radians(turned if first >= second else turned + 90)
    angle = None if first == second else axis_direction(theta)[0]
    return Ellipse((x + left, y + top), (float(max(first, second)), float(min(first, second))), angle)


def regress_line(points: NDArray[np.int32], width: int) -> Line:
    """The script's line through points, by least squares of perpendicular distances in single precision.

    Parameters
    ----------
    points : (N, 1, 2) int32, px, N >= 2.
    width : of the picture, px; the midpoint is that of the line between x = 0 and x = width, both ends cut to
        whole pixels.

    Returns
    -------
    line : to 2e-4 degrees and 1e-4 px, as far as OpenCV's single precision goes.

    Examples
    --------
    >>> import numpy as np
    >>> regress_line(np.array([[[0, 10]], [[100, 10]]], np.int32), 200)
    Line(angle=0.0, slope=0.0, midpoint=(99.5, 10.0))
    """
    # Relative to the contact, its place in the frame costs no precision.
    left, top = points.min(axis=(0, 1)).tolist()
    fitted = cv2.fitLine(points - np.array([left, top], np.int32), cv2.DIST_L2, 0, 0.01, 0.01)
    vx, vy, x, y = (float(value) for value in np.ravel(fitted))
    x, y = x + left, y + top
    angle, slope = axis_direction(math.atan2(vy, vx))
    if slope is None:
        return Line(angle, None, (x, y))
    at_left = int(-x * vy / vx + y)
    at_right = int((width - x) * vy / vx + y)
    return Line(angle, slope, ((width - 1) / 2, (at_left + at_right) / 2))


def get_convex_hull_area(mask: NDArray[np.uint8]) -> Contact | None:
    """Hull of all contours, and the line through its vertices; None for an empty mask.

    Parameters
    ----------
    mask : (H, W) uint8, non-zero in contact.

    Returns
    -------
    contact : area of the hull's polygon, px^2; angle, slope and center of `regress_line` (the center is the
        middle of that line across the picture, not of the contact); the ellipse of `fit_ellipse`.

    Raises
    ------
    ValueError : if the mask is not of that kind.

    Examples
    --------
    >>> import numpy as np
    >>> mask = np.zeros((40, 60), np.uint8)
    >>> mask[10:20, 15:46] = 255
    >>> get_convex_hull_area(mask).area
    270.0
    """
    outline = get_all_contour(mask)
    if len(outline) == 0:
        return None
    region_area = float(cv2.countNonZero(mask))
    polygon = np.asarray(cv2.convexHull(outline), np.int32)
    vertices = polygon.reshape(-1, 2).astype(np.float64)
    if len(vertices) < 2:
        place = (float(vertices[0, 0]), float(vertices[0, 1]))
        return Contact(0.0, place, None, None, vertices, None, 0.0, region_area)
    area = cv2.contourArea(polygon)
    line = regress_line(polygon, mask.shape[1])
    return Contact(
        area=area,
        center=line.midpoint,
        angle=line.angle,
        slope=line.slope,
        hull=vertices,
        ellipse=fit_ellipse(outline) if area > 0 else None,
        confidence=1.0,
        region_area=region_area,
    )


def mean_flow(markers: Markers, mask: NDArray[np.uint8], dilate: int = 0) -> Flow:
    """The numbers of the script's `draw_flow_mask`: mean displacement of the markers inside the contact.

    Every marker counts, lost ones too; positions and displacements are cut to whole pixels.

    Parameters
    ----------
    markers : as a tracker gives them, processed pixels.
    mask : (H, W) uint8, 255 in contact.
    dilate : px, >= 0; the mask is dilated by a square of side 2 * dilate + 1.

    Returns
    -------
    flow : mean, px, and count; the mean is None where no marker is inside.

    Raises
    ------
    ValueError : if the mask is not of that kind, or dilate is negative.

    Examples
    --------
    >>> import numpy as np
    >>> from tactflow.vision.types import Markers
    >>> origin = np.array([[5.0, 5.0], [20.0, 5.0]])
    >>> markers = Markers(origin, origin + 1.5, np.zeros(2, np.uint8), np.full(2, np.nan))
    >>> mask = np.zeros((20, 30), np.uint8)
    >>> mask[:, :10] = 255
    >>> mean_flow(markers, mask).mean
    (1.0, 1.0)
    """
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    if dilate < 0:
        raise ValueError(f"required dilate >= 0 px, got {dilate}")
    grown: NDArray[Any] = mask
    if dilate and mask.size:
        grown = cv2.dilate(mask, np.ones((2 * dilate + 1, 2 * dilate + 1), np.uint8))
    height, width = mask.shape
    pixels = np.trunc(markers.position)
    within = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    x, y = pixels[within].astype(np.intp).T
    chosen = np.flatnonzero(within)[grown[y, x] == 255]
    if len(chosen) == 0:
        return Flow(None, 0)
    mean = np.trunc(markers.displacement[chosen]).mean(axis=0)
    return Flow((float(mean[0]), float(mean[1])), len(chosen))


def _require_bgr(image: NDArray[np.uint8], name: str) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(
            f"{name}: required a non-empty (H, W, 3) uint8 array, got {image.shape} {image.dtype}"
        )


def _require_pair(frame: NDArray[np.uint8], frame0: NDArray[np.uint8]) -> None:
    _require_bgr(frame, "frame")
    if frame0.shape != frame.shape:
        raise ValueError(f"required a reference of shape {frame.shape}, got {frame0.shape}")
