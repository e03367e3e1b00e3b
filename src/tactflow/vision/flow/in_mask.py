"""Flow inside the contact, by its markers or by the field between them: mean, rotation, divergence."""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np

from tactflow.vision.arrays import Flags, Mask
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.flow.inside import inside_mask
from tactflow.vision.geometry.similarity import as_complex, fit_similarity
from tactflow.vision.types import Flow, Markers, MarkerStatus

MAX_UNKNOWN_SHARE: Final = 0.1
"""Largest unknown share of the variance of a mean flow. Simulated contacts within the grid of markers have
less than 0.04; for those beyond the last markers, which have more, the mean is wrong by pixels."""
MEDIAN_STDERR_RATIO: Final = math.sqrt(math.pi / 2)
"""Standard error of a median over that of the mean, of many normally distributed values. Derived."""
_MIN_SPREAD_RATIO: Final = 1e-3
"""Spread of markers across a line over that along it, 1, up to which they do not span a plane. Chosen by
hand."""
_TRACKED: Final = int(MarkerStatus.TRACKED)
_LOST: Final = int(MarkerStatus.LOST)


def flow_in_mask(markers: Markers, mask: Mask, *, average: Literal["mean", "median"] = "mean") -> Flow:
    """Summarise the displacement of the markers inside the contact.

    Parameters
    ----------
    markers : as the tracker gives them, processed pixels.
    mask : (H, W) uint8, not 0 inside the contact. A marker is inside if its *current* centre is.
    average : "median" takes that of each component, which a few wrong markers do not move, as the mean.

    Returns
    -------
    Flow : its mean is that of all markers inside, tracked or inferred; if only one of them is tracked, its
        displacement, since the others were inferred from markers outside. Rotation and divergence are those
        of the similarity that takes the markers' origins to their positions, by least squares. stderr is its
        residual scatter over the square root of the number of *tracked* markers; None with fewer than two.

    Raises
    ------
    ValueError : mask is not (H, W) uint8.

    Examples
    --------
    >>> origin = np.array([[10.0, 10], [20, 10], [10, 20], [90, 90]])
    >>> markers = Markers(origin, origin + [1.5, -0.5], np.zeros(4, np.uint8), np.full(4, 0.02))
    >>> mask = np.zeros((100, 100), np.uint8)
    >>> mask[:50, :50] = 255
    >>> flow = flow_in_mask(markers, mask)
    >>> flow.mean, flow.count
    ((1.5, -0.5), 3)
    """
    chosen = np.flatnonzero(_inside(markers, mask))
    tracked = chosen[markers.status[chosen] == _TRACKED]
    if len(tracked) == 1:
        chosen = tracked
    if len(chosen) == 0:
        return Flow(None, 0)
    origin = np.asarray(markers.origin[chosen], np.float64)
    moved = np.asarray(markers.position[chosen], np.float64) - origin
    fit = fit_similarity(as_complex(origin), as_complex(moved), np.full(len(chosen), 1 / len(chosen)))
    rest = as_complex(moved) - fit.mean
    rotation = divergence = residual = stderr = None
    parameters = 1
    # Product over squared sum of the principal scatters; about their ratio where one is small.
    squares = abs(complex((fit.away * fit.away).mean()))
    if len(chosen) >= 3 and (fit.spread**2 - squares**2) / 4 > (_MIN_SPREAD_RATIO * fit.spread) ** 2:
        parameters = 2
        rest = rest - fit.slope * fit.away
        rotation = _rotation(fit.slope.real, fit.slope.imag)
        divergence = _divergence(fit.slope.real, fit.slope.imag)
        residual = math.sqrt(float((np.abs(rest) ** 2).mean()))
    if len(tracked) >= 2:
        # The similarity has four parameters, two for each axis; the mean has one for each.
        count = (len(chosen) - parameters) * len(tracked)
        x, y = rest.real, rest.imag
        stderr = math.sqrt(float(x @ x) / count), math.sqrt(float(y @ y) / count)
    mean = fit.mean.real, fit.mean.imag
    if average == "median":
        mean = float(np.median(moved[:, 0])), float(np.median(moved[:, 1]))
        stderr = stderr and (MEDIAN_STDERR_RATIO * stderr[0], MEDIAN_STDERR_RATIO * stderr[1])
    return Flow(mean, len(chosen), stderr, rotation, divergence, residual)


def flow_of_field(field: DisplacementField, markers: Markers, mask: Mask, *, coarse: bool = False) -> Flow:
    """Summarise the displacement of the gel inside the contact, between its markers.

    Parameters
    ----------
    field : of this frame.
    markers : as for `flow_in_mask`; they only give the flow's `count`.
    mask : (H, W) uint8, 255 inside the contact, else 0.
    coarse : whether the outline is only approximate, as that of a contact that markers alone show. The
        standard error of the mean then is the RMS difference of the displacement within it.

    Returns
    -------
    Flow : its mean is the integral of the field over the contact, by area of the gel at rest, so that it does
        not jump when a marker enters. None where no marker is inside, or where the markers are too far away.
        Rotation, divergence and shear are those of the affine motion nearest to the field. The standard error
        of the mean includes that of the outline.

    Raises
    ------
    ValueError : mask is not (H, W) uint8.

    Examples
    --------
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
    count = int(np.count_nonzero(_inside(markers, mask)))
    motion = field.motion(mask) if count else None
    if motion is None or motion.unknown > MAX_UNKNOWN_SHARE:
        return Flow(None, count)
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


def _inside(markers: Markers, mask: Mask) -> Flags:
    """Which markers (N,) lie inside the mask; lost ones do not count."""
    return np.asarray(inside_mask(markers.position, mask) & (markers.status != _LOST))


def _rotation(spread: float, turn: float) -> float:
    """Degrees, counter-clockwise on the screen: y points down, so that a positive turn is clockwise."""
    return -math.degrees(math.atan2(turn, 1 + spread)) + 0.0


def _divergence(spread: float, turn: float) -> float:
    """Relative growth in area of a similarity, 1."""
    return 2 * spread + spread * spread + turn * turn
