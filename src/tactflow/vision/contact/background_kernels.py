"""Compiled loops of `background`.

Pictures of several channels are passed as planes, (3, h, w), which vectorise, or interleaved, (h, 3 w).
Borders are reflected about the last pixel, OpenCV's default.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from tactflow.vision.arrays import Bytes, Flags, Floats32
from tactflow.vision.compiled import kernel
from tactflow.vision.contact.illumination import MAX_GREY, positions, under_illumination

BLUR_SIGMA_PX: Final = 0.8
"""Standard deviation of the smoothing of changes, pixels of the window. Chosen by hand."""
NEIGHBOUR_WEIGHT: Final = 1 / (2 + math.exp(1 / (2 * BLUR_SIGMA_PX**2)))
"""Weight of each of the two neighbours of a pixel: a Gaussian with that standard deviation."""


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
    cells: Floats32,
    coefficients: Floats32,
    untouched: Floats32,
    before: Floats32,
    change: Floats32,
    deviations: Floats32,
) -> tuple[float, float, float, float]:
    """Deviations of each cell from the background under this frame's illumination.

    Returns the maxima of the squared deviations and of those of colour, and the sums of the evidence over the
    cells that were in contact in the previous frame, now and then.

    cells : (3, h, w), grey levels. coefficients : (3, 4), of `IlluminationModel.fit`. untouched : (9, h, w),
    `Derived.planes`. before : (h, w), the previous frame's evidence in contact, 0 elsewhere.
    change, deviations : (3, h, w), filled as in `background.Change`.
    """
    mean, weight, (brightness, colour_factor, scale) = untouched[:3], untouched[3:6], untouched[6:]
    gain, slope_x, slope_y, offset = coefficients.T[:, :, None, None]
    down, across = (positions(count) for count in cells.shape[1:])
    light = mean * (gain + slope_y * down[:, None] + slope_x * across) + offset
    shift = np.maximum(cells - mean - light, cells - MAX_GREY)
    change[:] = shift * scale
    deviation = shift * weight
    squared, colour, evidence = deviations
    squared[:] = (deviation * deviation).sum(axis=0)
    along = (deviation * weight * mean).sum(axis=0)
    colour[:] = (squared - along * along * brightness) * colour_factor
    evidence[:] = np.maximum(squared, colour)
    now, was = (values[before > 0].sum(dtype=np.float64) for values in (evidence, before))
    return float(squared.max()), float(colour.max()), float(now), float(was)


@kernel
def window_change(
    picture: Bytes,
    top: int,
    left: int,
    coefficients: Floats32,
    untouched: Floats32,
    inside: Flags,
    mixtures: Floats32,
    shown: Floats32,
    beside: float,
) -> None:
    """Mixtures of the signed changes of the channels in a window, in standard deviations, smoothed.

    picture : (H, 3 W), the frame at the window's resolution. top, left : of the window. coefficients :
    (3, 4), of `IlluminationModel.fit`. untouched : (2, H, 3 W), mean and one over the standard deviation.
    inside : (h / 2, w / 2), cells of 2 x 2 px that count. mixtures : (k, 3). shown : (k, h, w), filled, 0
    where nothing counts. beside : weight of each neighbour in the smoothing along x and y.
    """
    frame, mean, scale = np.stack([picture, *untouched]).reshape(3, len(picture), -1, 3).transpose(0, 3, 1, 2)
    change = (frame - under_illumination(mean, coefficients)) * scale
    window = change[:, top : top + shown.shape[1], left : left + shown.shape[2]]
    mixed = np.tensordot(mixtures, window, 1)
    for axis in (2, 1):
        line = np.pad(mixed, [(int(at == axis),) * 2 for at in range(3)], mode="reflect").swapaxes(axis, 0)
        mixed = ((line[:-2] + line[2:]) * beside + line[1:-1] * (1 - 2 * beside)).swapaxes(0, axis)
    shown[:] = mixed * inside.repeat(2, axis=0).repeat(2, axis=1)
