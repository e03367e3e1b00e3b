"""The functions of the original script under their original names, the baseline for time and error.

Not here: `get_processed_frame` and `inpaint` (the stages `preprocess` with `method: pyramid` and `inpaint`
with `method: telea`), and the drawing of `draw_flow` and `draw_flow_mask` (the stage `visualize`).
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.geometry.direction import axis_direction
from tactflow.vision.types import Contact, Ellipse, Flow, Markers

MASK_THRESHOLD_GREY: Final = 120
"""Amplified difference of Gaussians above which a channel votes for a marker, grey levels; from the
script."""

MARKER_AREAS_PX2: Final = (50.0, 500.0)
"""Smallest and largest area of a marker's contour, px^2; chosen by hand for markers of 9 px diameter."""

_MIN_AXIS_PX: Final = 1e-3
"""Axis length, px, below which `cv2.fitEllipse` has fitted a line; chosen by hand."""

_STRUCTURING_ELEMENT = np.ones((5, 5), np.uint8)
"""Structuring element with which the script erodes and dilates."""


def mask_marker(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mask of dark markers (H, W) uint8, 0 or 255, by a difference of Gaussians on the halved frame.

    A marker is where two of three channels exceed `MASK_THRESHOLD_GREY`. Enlarging the mask shifts it by half
    a pixel.

    frame : (H, W, 3) uint8, BGR.

    >>> mask_marker(np.full((40, 60, 3), 150, np.uint8)).any()
    np.False_
    """
    height, width = frame.shape[:2]
    small = cv2.pyrDown(np.ascontiguousarray(frame)).astype(np.float32)
    blur = cv2.GaussianBlur(small, (25, 25), 0)
    blur2 = cv2.GaussianBlur(small, (15, 15), 0)
    amplified = np.clip((blur - blur2) * np.float32(20), 0, 255)
    blue, green, red = (amplified[..., channel] > MASK_THRESHOLD_GREY for channel in range(3))
    votes = (blue & green) | (blue & red) | (green & red)
    enlarged = cv2.resize(votes.astype(np.uint8), (width, height))
    return np.asarray(enlarged * np.uint8(255), np.uint8)


def marker_center(frame: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Centres of the markers (N, 2) float64, px, by contour moments, in OpenCV's contour order.

    A contour counts if its area lies within `MARKER_AREAS_PX2` and the longer side of its bounding box is
    less than twice the shorter one. Centres have the half-pixel shift of `mask_marker`.

    frame : (H, W, 3) uint8, BGR.
    """
    least_area, most_area = MARKER_AREAS_PX2
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


def difference(frame: NDArray[np.uint8], frame0: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Contact mask (H, W) uint8, 0 or 255: where the gel is brighter by 14 grey levels in all channels.

    These are the script's steps, except that values outside 0..255 are clipped before conversion to uint8,
    which is undefined otherwise. Its factor on negative differences has no effect after the threshold of 140.

    frame, frame0 : (H, W, 3) uint8, BGR; the gel now and untouched, both without markers.

    >>> gel = np.full((40, 60, 3), 100, np.uint8)
    >>> difference(gel + np.uint8(14), gel).all(), difference(gel + np.uint8(13), gel).any()
    (np.True_, np.False_)
    """
    diff = (frame * 1.0 - frame0) / 255.0 + 0.5
    below = diff < 0.5
    diff[below] = (diff[below] - 0.5) * 0.7 + 0.5
    levels = np.clip(diff * 255, 0, 255).astype(np.uint8)
    levels[levels > 140] = 255
    levels[levels <= 140] = 0
    blue, green, red = cv2.split(levels)
    # Contact is where no channel exceeds another.
    dominated = (blue > green) | (blue > red) | (green > blue) | (green > red) | (red > blue) | (red > green)
    neutral = np.where(dominated, 0, 255).astype(np.uint8)
    gray = cv2.cvtColor(cv2.bitwise_and(levels, levels, mask=neutral), cv2.COLOR_BGR2GRAY)
    _, binary = cv2.threshold(gray, 50, 255, cv2.THRESH_BINARY)
    eroded = cv2.erode(binary, _STRUCTURING_ELEMENT, iterations=2)
    return np.asarray(cv2.dilate(eroded, _STRUCTURING_ELEMENT, iterations=1), np.uint8)


def get_all_contour(mask: NDArray[np.uint8]) -> NDArray[np.int32]:
    """The points of all outer contours, (N, 1, 2) int32, px; N is 0 for an empty mask.

    mask : (H, W) uint8, non-zero in contact.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(np.vstack(contours) if contours else np.empty((0, 1, 2)), np.int32)


def fit_ellipse(points: NDArray[np.int32]) -> Ellipse | None:
    """The script's ellipse through the points (N, 1, 2) int32, px, of `get_all_contour`.

    None if `cv2.fitEllipse` fails, for fewer than five points, and for a line.

    >>> mask = cv2.ellipse(np.zeros((80, 120), np.uint8), (60, 40), (30, 15), 0, 0, 360, 255, -1)
    >>> [round(length) for length in fit_ellipse(get_all_contour(mask)).axes]
    [60, 30]
    """
    if len(points) < 5:
        return None
    try:
        (x, y), (first, second), rotation = cv2.fitEllipse(points)
    except cv2.error:
        return None
    if not np.isfinite([x, y, first, second, rotation]).all() or min(first, second) <= _MIN_AXIS_PX:
        return None
    # OpenCV measures the angle of the first axis, clockwise on the screen.
    theta = math.radians(rotation if first >= second else rotation + 90)
    angle = None if first == second else axis_direction(theta)[0]
    return Ellipse((x, y), (float(max(first, second)), float(min(first, second))), angle)


def regress_line(points: NDArray[np.int32], width: int) -> tuple[float, float | None, tuple[float, float]]:
    """The script's line through points, by least squares of perpendicular distances.

    Returns its angle, degrees in (-90, 90], counter-clockwise on the screen; its slope dy/dx (y down), None
    where it is vertical; and (x, y), px, halfway between its ends at x = 0 and x = width, both truncated to
    whole pixels, or any of its points if it is vertical.

    points : (N, 1, 2) int32, px, N >= 2. width : of the image, px.

    >>> regress_line(np.array([[[0, 10]], [[100, 10]]], np.int32), 200)
    (0.0, 0.0, (99.5, 10.0))
    """
    vx, vy, x, y = (float(value) for value in np.ravel(cv2.fitLine(points, cv2.DIST_L2, 0, 0.01, 0.01)))
    angle, slope = axis_direction(math.atan2(vy, vx))
    if slope is None:
        return angle, None, (x, y)
    at_left = int(-x * vy / vx + y)
    at_right = int((width - x) * vy / vx + y)
    return angle, slope, ((width - 1) / 2, (at_left + at_right) / 2)


def get_convex_hull_area(mask: NDArray[np.uint8]) -> Contact | None:
    """Hull of all contours, the line through its vertices and the ellipse; None for an empty mask.

    `center` is the middle of that line across the image, not of the contact. `area` is that of the polygon,
    px^2.

    mask : (H, W) uint8, non-zero in contact.

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
        center = (float(vertices[0, 0]), float(vertices[0, 1]))
        return Contact(0.0, center, None, None, vertices, None, 0.0, region_area)
    area = cv2.contourArea(polygon)
    angle, slope, midpoint = regress_line(polygon, mask.shape[1])
    return Contact(
        area=area,
        center=midpoint,
        angle=angle,
        slope=slope,
        hull=vertices,
        ellipse=fit_ellipse(outline) if area > 0 else None,
        confidence=1.0,
        region_area=region_area,
    )


def mean_flow(markers: Markers, mask: NDArray[np.uint8], dilate: int = 0) -> Flow:
    """Mean displacement of the markers inside the contact, px, as in the script's `draw_flow_mask`.

    Lost markers count too; positions and displacements are truncated to whole pixels. The mean is None if no
    marker is inside.

    markers : from a tracker, processed pixels. mask : (H, W) uint8, 255 in contact.
    dilate : px, >= 0; dilates the mask by a square of side 2 * dilate + 1.

    >>> origin = np.array([[5.0, 5.0], [20.0, 5.0]])
    >>> markers = Markers(origin, origin + 1.5, np.zeros(2, np.uint8), np.full(2, np.nan))
    >>> mask = np.zeros((20, 30), np.uint8)
    >>> mask[:, :10] = 255
    >>> mean_flow(markers, mask).mean
    (1.0, 1.0)
    """
    dilated = cv2.dilate(mask, np.ones((2 * dilate + 1, 2 * dilate + 1), np.uint8))
    height, width = mask.shape
    pixels = np.trunc(markers.position)
    within = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    x, y = pixels[within].astype(np.intp).T
    chosen = np.flatnonzero(within)[dilated[y, x] == 255]
    if len(chosen) == 0:
        return Flow(None, 0)
    mean = np.trunc(markers.displacement[chosen]).mean(axis=0)
    return Flow((float(mean[0]), float(mean[1])), len(chosen))
