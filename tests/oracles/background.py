"""Plain versions of the kernels of the background model."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.background_kernels import CENTER_WEIGHT, NEIGHBOUR_WEIGHT

Float = NDArray[np.float32]


def _change(planes: Float, mean: Float, coefficients: Float, across: Float, down: Float) -> Float:
    gain, slope_x, slope_y, offset = coefficients.T[:, :, None, None]
    light = mean * (gain + slope_y * down[:, None] + slope_x * across) + offset
    return np.asarray(np.maximum(planes - mean - light, planes - np.float32(255)), np.float32)


def plain_smooth_cells(half: NDArray[np.uint8], smooth: Float) -> None:
    """Half the resolution, and a box filter."""
    picture = half.reshape(len(half), -1, 3)
    cells = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).reshape(
        *smooth.shape[1:], 3
    )
    means = cv2.boxFilter(cells, cv2.CV_32F, (3, 3))
    smooth[:] = means.reshape(*smooth.shape[1:], 3).transpose(2, 0, 1)


def plain_weigh_change(
    smooth: Float,
    coefficients: Float,
    across: Float,
    down: Float,
    mean: Float,
    weight: Float,
    brightness: Float,
    colour_factor: Float,
    before: NDArray[np.uint8],
    evidence_before: Float,
    squared: Float,
    colour: Float,
    evidence: Float,
) -> tuple[float, ...]:
    """Squared length of the weighted change; of its colour, without the part along the brightness."""
    change = _change(smooth, mean, coefficients, across, down)
    squared[:] = ((change * weight) ** 2).sum(axis=0)
    along = (change * weight**2 * mean).sum(axis=0)
    colour[:] = (squared - along**2 * brightness) * colour_factor
    np.maximum(squared, colour, out=evidence)
    inside = before > 0
    sums = (evidence[inside].sum(), evidence_before[inside].sum()) if before.size else (0.0, 0.0)
    return float(squared.max()), float(colour.max()), *sums


def plain_scaled_change(
    picture: NDArray[np.uint8],
    top: int,
    left: int,
    coefficients: Float,
    across: Float,
    down: Float,
    mean: Float,
    scale: Float,
    change: Float,
) -> None:
    """The change less that of the light, in standard deviations, smoothed along x."""
    high, wide = len(change), change.shape[1] // 3
    rows, columns = slice(top, top + high), slice(left, left + wide)
    planes, usual, unit = (
        array.reshape(len(array), -1, 3)[rows, columns].transpose(2, 0, 1) for array in (picture, mean, scale)
    )
    scaled = _change(planes, usual, coefficients, across[columns], down[rows]) * unit
    weights: Any = np.array([NEIGHBOUR_WEIGHT, CENTER_WEIGHT, NEIGHBOUR_WEIGHT], np.float64)
    smooth = cv2.sepFilter2D(np.stack(list(scaled), axis=2), cv2.CV_32F, weights, np.ones(1))
    change[:] = smooth.reshape(change.shape)
