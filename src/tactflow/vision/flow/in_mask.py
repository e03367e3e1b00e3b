"""Flow of the markers inside the contact: mean displacement, twist, press."""

from __future__ import annotations

import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision import compiled
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.inside import inside_outline
from tactflow.vision.types import Flow, Markers, MarkerStatus

FloatArray = NDArray[np.float64]

# Markers whose scatter across a line is below this share of that along it do not span a plane.
_FLAT: Final = 1e-3
# How far from a mark's rim the region's outline is still bent by it, px: by what its mask takes more than the
# mark, and by the smoothing after that.
HIDDEN: Final = 2.5
_TRACKED: Final = int(MarkerStatus.TRACKED)
_LOST: Final = int(MarkerStatus.LOST)


def flow_in_mask(markers: Markers, mask: NDArray[np.uint8], *, dilate: float = 0.0) -> Flow:
    """Summarise the displacement of the markers inside the contact.

    markers : as the tracker gives them, processed pixels.
    mask : (H, W) uint8, non-zero inside the contact.
    dilate : px; a marker is inside if its *current* centre lies at most this far outside of the region. More
        takes in more markers (a steadier mean), also such as move less because they lie outside the contact.
        Where the markers' radius is known, the region's outline is bridged below each of them
        (`tactflow.vision.contact.inside`) and the distance counts to a fraction of a pixel; otherwise it is
        that between the pixel that a centre falls on and the nearest pixel of the mask.

    Tracked and inferred markers have equal weight, since the mean is one over the contact's area and not over
    how well each marker is seen; but a single tracked marker stands alone, since an inferred one has its
    motion from neighbours, which are then outside and move otherwise. Lost ones count nowhere.

    rotation and divergence come from the least-squares similarity that takes the markers' origins to their
    positions (closed form, as in Umeyama, 1991, here by complex numbers). Both and the residual are the
    same about every point, so also about the contact's centroid. stderr is the scatter that the similarity
    leaves unexplained (with fewer than three markers, or in a line: the scatter of the displacements), over
    the square root of the number of *tracked* markers, since an inferred one is no observation of its own;
    None with fewer than two of those.

    Computed in float64. Markers in float32 give the same to their own rounding: a mean to 2^-23 of the
    largest coordinate, a rotation to that over the distance of the markers.

    Raises ValueError if mask is not (H, W) uint8, or if dilate is negative or not finite.
    """
    _check(mask, dilate)
    if markers.radius is None:
        inside = inside_mask(markers.position, mask, dilate)
    else:
        inside = inside_outline(markers.position, mask, markers.radius + HIDDEN, dilate)
    chosen = np.flatnonzero(inside & (markers.status != _LOST))
    seen = chosen[markers.status[chosen] == _TRACKED]
    if len(seen) == 1:
        chosen = seen
    count = len(chosen)
    if count == 0:
        return Flow(None, 0)
    sums = _sums(np.asarray(markers.origin, np.float64), np.asarray(markers.position, np.float64), chosen)
    x, y, turned, growth_x, growth_y, rest_x, rest_y = sums
    rotation = divergence = residual = None
    if turned:
        # y points down: a positive turn is clockwise on the screen.
        rotation = -math.degrees(math.atan2(growth_y, 1 + growth_x)) + 0.0
        divergence = 2 * growth_x + growth_x * growth_x + growth_y * growth_y
        residual = math.sqrt((rest_x + rest_y) / count)
    stderr = None
    if len(seen) >= 2:
        # The similarity has four parameters, two for each axis; the mean has one for each.
        free = (count - (2 if turned else 1)) * len(seen)
        stderr = (math.sqrt(rest_x / free), math.sqrt(rest_y / free))
    return Flow((x, y), count, stderr, rotation, divergence, residual)


def _sums(origin: FloatArray, position: FloatArray, chosen: NDArray[np.intp]) -> list[float]:
    """Mean displacement x, y; 1 if the similarity is known, else 0; its real and imaginary part, less 1; the
    sums of the squares, x and y, of what it leaves; of the markers `chosen` (n,) of (N, 2) px. See `_fit`."""
    if compiled.active():
        sums = np.empty(7)
        _fit(np.ascontiguousarray(origin), np.ascontiguousarray(position), chosen, sums)
        return sums.tolist()
    grid = origin[chosen]
    left = position[chosen] - grid
    mean = left.mean(axis=0)
    left -= mean
    grid -= grid.mean(axis=0)
    growth = np.zeros(2)
    x, y = grid.T
    squares = float(x @ x), float(y @ y)
    scatter = squares[0] + squares[1]
    # Product over squared sum of the principal scatters; about their ratio where one is small.
    turned = len(grid) >= 3 and squares[0] * squares[1] - float(x @ y) ** 2 > _FLAT**2 * scatter**2
    if turned:
        growth = np.array([x @ left[:, 0] + y @ left[:, 1], x @ left[:, 1] - y @ left[:, 0]]) / scatter
        left -= np.column_stack([growth[0] * x - growth[1] * y, growth[1] * x + growth[0] * y])
    return [*mean.tolist(), float(turned), *growth.tolist(), *(left * left).sum(axis=0).tolist()]


@kernel("void(float64[:, ::1], float64[:, ::1], int64[::1], float64[::1])")
def _fit(origin: FloatArray, position: FloatArray, chosen: NDArray[np.intp], sums: FloatArray) -> None:
    """Set `sums`, see `_sums`."""
    count = chosen.size
    at_x = at_y = mean_x = mean_y = 0.0
    for index in chosen:
        at_x, at_y = at_x + origin[index, 0], at_y + origin[index, 1]
        mean_x += position[index, 0] - origin[index, 0]
        mean_y += position[index, 1] - origin[index, 1]
    at_x, at_y, mean_x, mean_y = at_x / count, at_y / count, mean_x / count, mean_y / count
    xx = xy = yy = along = across = 0.0
    for index in chosen:
        x, y = origin[index, 0] - at_x, origin[index, 1] - at_y
        u = position[index, 0] - origin[index, 0] - mean_x
        v = position[index, 1] - origin[index, 1] - mean_y
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
        along, across = along + x * u + y * v, across + x * v - y * u
    turned = count >= 3 and xx * yy - xy * xy > _FLAT * _FLAT * (xx + yy) * (xx + yy)
    growth_x, growth_y = (along / (xx + yy), across / (xx + yy)) if turned else (0.0, 0.0)
    rest_x = rest_y = 0.0
    for index in chosen:
        x, y = origin[index, 0] - at_x, origin[index, 1] - at_y
        u = position[index, 0] - origin[index, 0] - mean_x - (growth_x * x - growth_y * y)
        v = position[index, 1] - origin[index, 1] - mean_y - (growth_y * x + growth_x * y)
        rest_x, rest_y = rest_x + u * u, rest_y + v * v
    sums[0], sums[1], sums[2], sums[3], sums[4] = mean_x, mean_y, turned, growth_x, growth_y
    sums[5], sums[6] = rest_x, rest_y


def _check(mask: NDArray[np.uint8], dilate: float) -> None:
    if mask.ndim != 2 or mask.dtype != np.uint8:
        raise ValueError(f"required a mask of shape (H, W) and dtype uint8, got {mask.shape} {mask.dtype}")
    if not (dilate >= 0 and math.isfinite(dilate)):
        raise ValueError(f"required dilate >= 0 px, got {dilate}")


def inside_mask(points: NDArray[Any], mask: NDArray[np.uint8], dilate: float = 0.0) -> NDArray[np.bool_]:
    """Which points fall on a pixel that has a non-zero pixel of the mask within `dilate` px.

    points : (N, 2) float, px, x right, y down; points outside the frame are judged by their distance too.
    mask : (H, W) uint8. dilate : px, >= 0, between pixel centres.
    Returns (N,) bool. The same as dilating the mask by a disc and looking the points up, at the cost of the
    mask's bounding box instead of the frame. Raises ValueError if mask is not (H, W) uint8, or if dilate is
    negative or not finite.
    """
    _check(mask, dilate)
    inside = np.zeros(len(points), np.bool_)
    if len(points) == 0 or mask.size == 0:
        return inside
    left, top, width, height = cv2.boundingRect(mask)
    if width == 0:
        return inside
    pixels = np.rint(points) - (left, top)
    reach = math.floor(dilate)
    near = np.flatnonzero(
        (pixels[:, 0] >= -reach)
        & (pixels[:, 0] < width + reach)
        & (pixels[:, 1] >= -reach)
        & (pixels[:, 1] < height + reach)
    )
    if len(near) == 0:
        return inside
    x, y = pixels[near].astype(np.intp).T
    roi: NDArray[Any] = mask[top : top + height, left : left + width]
    if reach == 0:
        inside[near] = roi[y, x] != 0
        return inside
    # Row by row of the disc, how many mask pixels lie in it, from sums over rectangles.
    ones: NDArray[Any] = cv2.threshold(roi, 0, 1, cv2.THRESH_BINARY)[1]
    sums = np.asarray(cv2.integral(ones))
    # Only rows that the mask has, so that a huge reach costs no more than the mask's height.
    down = np.arange(max(-reach, -int(y.max())), min(reach, height - 1 - int(y.min())) + 1)
    half = np.floor(np.sqrt(dilate**2 - down**2) + 1e-9).astype(np.intp)
    upper = y[:, None] + down
    begin, end = _clip(upper, height), _clip(upper + 1, height)
    first, last = _clip(x[:, None] - half, width), _clip(x[:, None] + half + 1, width)
    found = sums[end, last] - sums[begin, last] - sums[end, first] + sums[begin, first]
    inside[near] = found.any(axis=1)
    return inside


def _clip(values: NDArray[np.intp], high: int) -> NDArray[np.intp]:
    # np.clip costs 6 us a call on small arrays, these two 1 us.
    return np.minimum(np.maximum(values, 0), high)
