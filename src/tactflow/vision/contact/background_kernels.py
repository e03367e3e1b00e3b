"""Compiled loops of `background`.

Pictures of several channels are passed as planes, (3, h, w), which vectorise, or interleaved, (h, 3 w).
Borders are reflected about the last pixel, OpenCV's default.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from tactflow.vision.arrays import Bytes, Floats32
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.illumination import SATURATION_GREY

BLUR_SIGMA_PX: Final = 0.8
"""Standard deviation of the smoothing of changes, pixels of the window. Chosen by hand."""
_AT_ONE: Final = math.exp(-1 / (2 * BLUR_SIGMA_PX**2))
CENTER_WEIGHT: Final = 1 / (1 + 2 * _AT_ONE)
NEIGHBOUR_WEIGHT: Final = _AT_ONE / (1 + 2 * _AT_ONE)
"""Weights of a pixel and of each of its two neighbours: a Gaussian with that standard deviation."""


@kernel
def smooth_cells(half: Bytes, smooth: Floats32) -> None:
    """Fill the planes `smooth`, (3, h, w), with means over 3 x 3 cells.

    half : (2 h, 6 w), a picture with cells of 2 x 2 pixels; their mean is rounded, as in `halved`.
    """
    _, high, wide = smooth.shape
    pixels = half.reshape(high, 2, wide, 2, 3).astype(np.uint16)
    cells = (pixels.sum(axis=(1, 3)) + 2) >> 2
    around = np.pad(cells, ((1, 1), (1, 1), (0, 0)), mode="reflect")
    rows = around[:-2] + around[1:-1] + around[2:]
    sums = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    smooth[:] = sums.transpose(2, 0, 1) / smooth.dtype.type(9)


@kernel
def weigh_change(
    smooth: Floats32,
    coefficients: Floats32,
    across: Floats32,
    down: Floats32,
    mean: Floats32,
    weight: Floats32,
    brightness: Floats32,
    colour_factor: Floats32,
    before: Bytes,
    evidence_before: Floats32,
    squared: Floats32,
    colour: Floats32,
    evidence: Floats32,
) -> tuple[float, float, float, float]:
    """Squared deviations of each cell from the background under this frame's illumination.

    Returns the maxima of squared and of colour, and the sums of the evidence over `before` in this frame and
    in the previous one.

    smooth, mean, weight : (3, h, w). brightness, colour_factor : (h, w). coefficients : (3, 4). across,
    down : positions, (w,) and (h,). before : (h, w), cells in contact in the previous frame, and
    evidence_before : the evidence there; both (0, 0) if there were none. squared, colour, evidence : (h, w),
    filled.
    """
    gain, slope_x, slope_y, offset = coefficients.T[:, :, None, None]
    light = mean * (gain + slope_y * down[:, None] + slope_x * across) + offset
    change = np.maximum(smooth - mean - light, smooth - SATURATION_GREY)
    deviation = change * weight
    squared[:] = (deviation * deviation).sum(axis=0)
    along = (deviation * weight * mean).sum(axis=0)
    colour[:] = (squared - along * along * brightness) * colour_factor
    evidence[:] = np.maximum(squared, colour)
    inside = before != 0 if before.size else np.zeros(squared.shape, np.bool_)
    was = evidence_before[inside].sum(dtype=np.float64) if before.size else 0.0
    now = evidence[inside].sum(dtype=np.float64)
    return float(squared.max()), float(colour.max()), float(now), float(was)


@kernel
def scaled_change(
    picture: Bytes,
    top: int,
    left: int,
    coefficients: Floats32,
    across: Floats32,
    down: Floats32,
    mean: Floats32,
    scale: Floats32,
    change: Floats32,
    beside: float,
) -> None:
    """Signed change in a window, in standard deviations, smoothed along x.

    picture : (H, 3 W), the frame at the window's resolution. top, left : of the window. coefficients :
    (3, 4), of `IlluminationModel.fit`. across, down : positions, (W,) and (H,). mean, scale : (H, 3 W).
    change : (h, 3 w), filled. beside : weight of each neighbour.
    """
    high, wide = change.shape[0], change.shape[1] // 3
    rows, columns = slice(top, top + high), slice(3 * left, 3 * (left + wide))
    values: Any = picture[rows, columns].astype(mean.dtype).reshape(high, wide, 3)
    usual, unit = (each[rows, columns].reshape(high, wide, 3) for each in (mean, scale))
    gain, slope_x, slope_y, offset = coefficients.T
    gains = gain + slope_x * across[left : left + wide, None] + slope_y * down[rows, None, None]
    light = values - usual - (usual * gains + offset)
    line = np.maximum(light, values - SATURATION_GREY) * unit
    line = np.pad(line, ((0, 0), (1, 1), (0, 0)), mode="reflect")
    smooth = (line[:, :-2] + line[:, 2:]) * beside + line[:, 1:-1] * (1 - 2 * beside)
    change[:] = smooth.reshape(change.shape)
