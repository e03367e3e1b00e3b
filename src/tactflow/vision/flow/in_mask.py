"""Flow inside the contact, by its markers or by the field between them: mean, rotation, divergence."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.flow.displacement_field import DisplacementField, GelMotion
from tactflow.vision.flow.inside import inside_mask
from tactflow.vision.flow.similarity import Similarity, fit_similarity
from tactflow.vision.geometry.moments import RegionProperties
from tactflow.vision.types import Flow, Markers, MarkerStatus

UNKNOWN: Final = 0.1
"""Share of what the mean flow could be that markers may leave open. Simulated contacts within the grid of
markers leave less than 0.04; those beyond the last markers leave more, and there the mean is wrong by
pixels."""
_TRACKED: Final = int(MarkerStatus.TRACKED)
_LOST: Final = int(MarkerStatus.LOST)


def flow_in_mask(markers: Markers, mask: NDArray[np.uint8], *, dilate: float = 0.0) -> Flow:
    """Summarise the displacement of the markers inside the contact.

    markers : as the tracker gives them, processed pixels.
    mask : (H, W) uint8, non-zero inside the contact.
    dilate : px; a marker is inside if its *current* centre lies at most this far outside of the region. More
        takes in more markers (a steadier mean), also such as move less because they lie outside the contact.
        The distance is that between the pixel that a centre falls on and the nearest pixel of the mask.

    Tracked and inferred markers have equal weight, since the mean is one over the contact's area and not over
    how well each marker is seen; but a single tracked marker stands alone, since an inferred one has its
    motion from neighbours, which are then outside and move otherwise. Lost ones count nowhere.

    rotation and divergence come from the least-squares similarity that takes the markers' origins to their
    positions. Both and the residual are the same about every point, so also about the contact's centroid.
    stderr is the scatter that the similarity leaves unexplained (with fewer than three markers, or in a line:
    the scatter of the displacements), over the square root of the number of *tracked* markers, since an
    inferred one is no observation of its own; None with fewer than two of those.

    Computed in float64. Markers in float32 give the same to their own rounding: a mean to 2^-23 of the
    largest coordinate, a rotation to that over the distance of the markers.

    Raises ValueError if mask is not (H, W) uint8, or if dilate is negative or not finite.

    >>> origin = np.array([[10.0, 10], [20, 10], [10, 20], [90, 90]])
    >>> markers = Markers(origin, origin + [1.5, -0.5], np.zeros(4, np.uint8), np.full(4, 0.02))
    >>> mask = np.zeros((100, 100), np.uint8)
    >>> mask[:50, :50] = 255
    >>> flow = flow_in_mask(markers, mask)
    >>> flow.mean, flow.count
    ((1.5, -0.5), 3)
    """
    chosen = np.flatnonzero(_inside(markers, mask, dilate))
    tracked = chosen[markers.status[chosen] == _TRACKED]
    if len(tracked) == 1:
        chosen = tracked
    if len(chosen) == 0:
        return Flow(None, 0)
    origin, position = np.asarray(markers.origin, np.float64), np.asarray(markers.position, np.float64)
    return _summary(fit_similarity(origin, position, chosen), len(chosen), len(tracked))


def flow_of_field(
    field: DisplacementField,
    markers: Markers,
    mask: NDArray[np.uint8],
    *,
    dilate: float = 0.0,
    coarse: bool = False,
    region: RegionProperties | None = None,
) -> Flow:
    """Summarise the displacement of the gel inside the contact, between its markers.

    field : of this frame. mask : (H, W) uint8, 255 inside the contact, else 0.
    markers, dilate : as `flow_in_mask` takes them; with the mask they tell `count`.
    coarse : whether the mask is only where a contact is to be found, as one that markers alone show: then the
        standard error of the mean is how much the displacement differs within it.
    region : properties of the mask, where they are known; those of another one do not count.

    The mean is an integral over the contact, each bit of gel counted by its area at rest. A marker at the
    outline in or out makes no jump: it counts as much as before. Rotation, divergence and shear are those of
    the affine motion nearest to the field. Standard errors are those of the field between its markers; that
    of the mean has the error of the contact's outline besides. The mean is None where no marker is inside,
    and where markers are too far away: where more than `UNKNOWN` of what it could be is open.

    Raises ValueError if mask is not (H, W) uint8, or if dilate is negative or not finite.

    >>> from tactflow.vision.flow.displacement_field import FieldModel
    >>> x, y = np.meshgrid(np.arange(10.0, 100, 20), np.arange(10.0, 100, 20))
    >>> origin = np.column_stack([x.ravel(), y.ravel()])
    >>> markers = Markers(origin, origin + [1.5, -0.5], np.zeros(25, np.uint8), np.full(25, 0.02))
    >>> mask = np.zeros((100, 100), np.uint8)
    >>> mask[40:60, 40:60] = 255
    >>> flow = flow_of_field(FieldModel(origin, (100, 100))(markers), markers, mask)
    >>> [round(value, 1) for value in flow.mean], flow.count
    ([1.5, -0.5], 1)
    """
    count = int(np.count_nonzero(_inside(markers, mask, dilate)))
    box = region.box if region is not None and region.mask is mask else None
    motion = field.motion(mask, box) if count else None
    if motion is None or motion.unknown > UNKNOWN:
        return Flow(None, count)
    return _field_summary(motion, count, coarse)


def _inside(markers: Markers, mask: NDArray[np.uint8], dilate: float) -> NDArray[np.bool_]:
    """Which markers (N,), lost ones left out, lie inside the mask, or at most `dilate` px outside."""
    known: NDArray[np.bool_] = markers.status != _LOST
    return inside_mask(markers.position, mask, dilate) & known


def _field_summary(motion: GelMotion, count: int, coarse: bool) -> Flow:
    outline = (motion.spread, motion.spread) if coarse else motion.outline_stderr
    stderr = math.hypot(motion.stderr, outline[0]), math.hypot(motion.stderr, outline[1])
    gradient = motion.gradient
    if gradient is None:
        return Flow(motion.mean, count, stderr)
    spread, turn = gradient.growth
    error = gradient.stderr
    return Flow(
        motion.mean,
        count,
        stderr,
        _rotation(spread, turn),
        _divergence(spread, turn),
        motion.residual,
        gradient.shear,
        math.degrees(error),
        2 * error,
        2 * error,
    )


def _rotation(spread: float, turn: float) -> float:
    """Degrees, counter-clockwise on the screen: y points down, so that a positive turn is clockwise."""
    return -math.degrees(math.atan2(turn, 1 + spread)) + 0.0


def _divergence(spread: float, turn: float) -> float:
    """Relative growth in area of a similarity, 1."""
    return 2 * spread + spread * spread + turn * turn


def _summary(fit: Similarity, count: int, tracked: int) -> Flow:
    """The flow of `count` markers, of which `tracked` were seen."""
    rotation = divergence = residual = None
    if fit.fitted:
        rotation = _rotation(fit.growth_x, fit.growth_y)
        divergence = _divergence(fit.growth_x, fit.growth_y)
        residual = math.sqrt((fit.rest_x + fit.rest_y) / count)
    stderr = None
    if tracked >= 2:
        # The similarity has four parameters, two for each axis; the mean has one for each.
        free = (count - (2 if fit.fitted else 1)) * tracked
        stderr = (math.sqrt(fit.rest_x / free), math.sqrt(fit.rest_y / free))
    return Flow((fit.mean_x, fit.mean_y), count, stderr, rotation, divergence, residual)
