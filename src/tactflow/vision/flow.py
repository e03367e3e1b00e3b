"""Flow of the markers inside the contact: mean displacement, twist, press."""

from __future__ import annotations

import math
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.outline import inside_outline
from tactflow.vision.types import Flow, Markers, MarkerStatus

Method = Literal["mean", "seed"]

# Markers whose scatter across a line is below this share of that along it do not span a plane.
_FLAT: Final = 1e-3
# How far from a mark's rim the region's outline is still bent by it, px: by what its mask takes more than the
# mark, and by the smoothing after that.
HIDDEN: Final = 2.5
_TRACKED: Final = int(MarkerStatus.TRACKED)
_LOST: Final = int(MarkerStatus.LOST)


def flow_in_mask(
    markers: Markers, mask: NDArray[np.uint8], *, dilate: float = 0.0, method: Method = "mean"
) -> Flow:
    """Summarise the displacement of the markers inside the contact (seed function `draw_flow_mask`).

    markers : as the tracker gives them, processed pixels.
    mask : (H, W) uint8, non-zero inside the contact.
    dilate : px; a marker is inside if its *current* centre lies at most this far outside of the region. More
        takes in more markers (a steadier mean), also such as move less because they lie outside the contact.
        Where the markers' radius is known, the region's outline is bridged below each of them
        (`tactflow.vision.outline`) and the distance counts to a fraction of a pixel; otherwise it is that
        between the pixel that a centre falls on and the nearest pixel of the mask.
    method : "mean" uses tracked and inferred markers with equal weight, since the mean is one over the
        contact's area and not over how well each marker is seen; lost ones count nowhere. "seed" is the
        original: every marker, position and displacement cut to whole pixels, a square of side
        2 * round(dilate) + 1 as structuring element, nothing but mean and count.

    rotation and divergence come from the least-squares similarity that takes the markers' origins to their
    positions (closed form, as in Umeyama, 1991, here by complex numbers). Both and the residual are the
    same about every point, so also about the contact's centroid. stderr is the scatter that the similarity
    leaves unexplained (with fewer than three markers, or in a line: the scatter of the displacements), over
    the square root of the number of *tracked* markers, since an inferred one is no observation of its own;
    None with fewer than two of those.

    Computed in float64. Markers in float32 give the same to their own rounding: a mean to 2^-23 of the
    largest coordinate, a rotation to that over the distance of the markers.

    Raises ValueError if mask is not (H, W) uint8, if dilate is negative or not finite, or for an unknown
    method.
    """
    _check(mask, dilate)
    if method not in ("mean", "seed"):
        raise ValueError(f"required method to be 'mean' or 'seed', got {method!r}")
    if method == "seed":
        return _seed_flow(markers, mask, round(dilate))
    chosen = np.flatnonzero(markers.status != _LOST)
    position = markers.position[chosen]
    if markers.radius is None:
        chosen = chosen[inside_mask(position, mask, dilate)]
    else:
        chosen = chosen[inside_outline(position, mask, markers.radius + HIDDEN, dilate)]
    count = len(chosen)
    if count == 0:
        return Flow(None, 0)
    origin = markers.origin[chosen].astype(np.float64, copy=False)
    moved = markers.position[chosen].astype(np.float64, copy=False) - origin
    mean = moved.mean(axis=0)
    left = moved - mean
    tracked = int(np.count_nonzero(markers.status[chosen] == _TRACKED))
    rotation = divergence = residual = None
    parameters = 1
    grid = origin - origin.mean(axis=0)
    if count >= 3 and _spans_plane(grid):
        z = grid[:, 0] + 1j * grid[:, 1]
        d = left[:, 0] + 1j * left[:, 1]
        growth = complex(np.vdot(z, d)) / float(np.vdot(z, z).real)
        rest = d - growth * z
        left = np.column_stack([rest.real, rest.imag])
        # y points down: a positive turn of z is clockwise on the screen.
        rotation = -math.degrees(math.atan2(growth.imag, 1 + growth.real)) + 0.0
        divergence = 2 * growth.real + abs(growth) ** 2
        residual = math.sqrt(float(np.vdot(rest, rest).real) / count)
        # The similarity has four parameters, two for each axis.
        parameters = 2
    stderr = None
    if tracked >= 2:
        scatter = np.sqrt((left**2).sum(axis=0) / (count - parameters) / tracked)
        stderr = (float(scatter[0]), float(scatter[1]))
    return Flow((float(mean[0]), float(mean[1])), count, stderr, rotation, divergence, residual)


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


def _spans_plane(grid: NDArray[np.float64]) -> bool:
    xx, yy = float(grid[:, 0] @ grid[:, 0]), float(grid[:, 1] @ grid[:, 1])
    xy = float(grid[:, 0] @ grid[:, 1])
    # Product over squared sum of the principal scatters; about their ratio where one is small.
    return xx * yy - xy * xy > _FLAT**2 * (xx + yy) ** 2


def _seed_flow(markers: Markers, mask: NDArray[np.uint8], dilate: int) -> Flow:
    grown: NDArray[Any] = mask
    if dilate:
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
