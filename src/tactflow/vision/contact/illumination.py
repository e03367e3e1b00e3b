"""Robust fit of a smooth change of the illumination over the whole frame, also during contact."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from tactflow.vision.arrays import SATURATED_GREY, Flags, Floats32
from tactflow.vision.compiled import kernel

BLOCK_CELLS: Final = 8
"""Side of the blocks whose means are fitted, cells. Chosen by hand."""
CLIP_STDDEVS: Final = 2.0
"""Residuals are clipped at this number of standard deviations of a cell. Chosen by hand."""
REJECT_CLIP_RATIO: Final = 6.0
"""Residuals above this multiple of the clipping limit are rejected in the second fit. Chosen on the simulated
bright_cable, whose centre moves by 0.1 px more the lower it is, down to 2."""
MAX_STEPS: Final = 12
"""Maximum number of least-squares steps. Chosen by hand; the fit usually converges earlier."""
MIN_STEP_GREY: Final = 0.05
"""The fit has converged when no coefficient moves by more than this, grey levels. Chosen by hand."""
RIDGE_PENALTIES: Final = (0.0, 0.05, 0.05, 0.1)
"""Ridge penalties of gain, slopes and offset, relative to the data: on a gel of uniform brightness an offset
is nearly the same as a gain, and slopes follow wide, faint contacts. Chosen on wedge_grasp, where 0.01 for
the slopes misses 8 of 324 frames more than 0.1, and seu_a, whose light smaller values follow better."""
MAX_GREY: Final = np.float32(255)
"""Grey level at which a camera saturates."""
MIN_BLOCK_BRIGHTNESS: Final = 0.25
"""Minimum brightness of a block, relative to the mean of its channel, to take part in the initial estimate.
Chosen by hand."""


class IlluminationModel:
    """Robust fit of gain, slopes of the gain and offset per channel between a frame and the untouched gel.

    Exposure, white balance and lamps multiply the light; a camera's black level and scattered light add an
    offset. The four coefficients of a channel are fitted to means over blocks of 8 x 8 cells by Huber's
    method of modified residuals: residuals are clipped to twice their standard deviation before each step of
    weighted least squares, so a contact, however strong, pulls no harder than noise, and the matrix of the
    step is constant. A second fit continues from there and rejects residuals of several times that size, so
    that a strong contact does not pull at all. The first fit starts at the median, so a contact may cover
    nearly half of the frame. Saturated blocks are excluded; if a channel has no others, its gain is the
    smallest that saturates them. Computed in float32, within 1e-3 grey levels of the result in float64.

    Parameters
    ----------
    reference, variance : (3, h, w) float32, mean (grey levels) and variance of the untouched gel's cells.
    gel : (h, w) bool, cells that show gel and are fitted; None: all.

    References
    ----------
    P. J. Huber, "Robust Statistics", 1981, chapter 7.8.

    Examples
    --------
    >>> import numpy as np
    >>> gel = np.random.default_rng(0).uniform(90, 110, (3, 40, 32)).astype(np.float32)
    >>> model = IlluminationModel(gel, np.ones_like(gel))
    >>> coefficients = model.fit(gel * 1.2)
    >>> bool(abs(under_illumination(gel, coefficients) - 1.2 * gel).max() < 0.1)
    True
    """

    def __init__(self, reference: Floats32, variance: Floats32, gel: Flags | None = None) -> None:
        height, width = reference.shape[1:]
        self._weights = tuple(_block_weights(max(1, side // BLOCK_CELLS), side) for side in (height, width))
        center: Floats32 = np.maximum(reference.mean(axis=(1, 2)), np.float32(1))
        relative = reference / center[:, None, None]
        slopes = np.stack([relative * positions(width), relative * positions(height)[:, None]], axis=1)
        terms = np.concatenate([relative[:, None], slopes, np.ones_like(relative)[:, None]], axis=1)
        basis = np.stack([self._block_means(channel) for channel in terms])
        gel_blocks = self._gel_blocks(np.ones((height, width), np.bool_) if gel is None else gel)
        weight = gel_blocks / self._block_means(variance)[:, None]
        fitted = basis * weight
        penalty = weight.sum(axis=2)[:, :, None] * np.diag(RIDGE_PENALTIES)
        inverse = np.linalg.inv(fitted @ basis.transpose(0, 2, 1) + penalty + 1e-6 * np.eye(4))
        lit = (basis[:, 0] > MIN_BLOCK_BRIGHTNESS) & gel_blocks
        per_brightness = np.where(lit, 1 / np.maximum(basis[:, 0], MIN_BLOCK_BRIGHTNESS), 0)
        limit = np.float32(CLIP_STDDEVS) * np.sqrt(self._block_means(variance))
        blocks = np.stack([self._block_means(reference), per_brightness, limit])
        fit = blocks, basis, inverse @ fitted, (inverse @ penalty).transpose(0, 2, 1), center
        self._fit = [np.ascontiguousarray(values, np.float32) for values in fit]

    def fit(self, cells: Floats32) -> Floats32:
        """Coefficients of the change of illumination between the reference and a frame.

        cells : (3, h, w) float32, the frame's cells, grey levels.
        Returns (3, 4) float32: gain minus 1, its slopes along x and y (over the whole frame), and the offset,
        grey levels.
        """
        coefficients = np.zeros((3, 4), np.float32)
        limits = SATURATED_GREY, MAX_STEPS, MIN_STEP_GREY, REJECT_CLIP_RATIO
        rows, columns = self._weights
        blocks, basis, step, shrink, center = self._fit
        fit_light(cells, rows, columns, blocks, basis, step, shrink, center, coefficients, *limits)
        return coefficients

    def _gel_blocks(self, gel: Flags) -> Flags:
        """Whether at least half of each block, (n,), is gel; all are if there is no such block."""
        found = self._block_means(gel[None].astype(np.float32))[0] >= np.float32(0.5)
        return np.asarray(found if found.any() else ~found, np.bool_)

    def _block_means(self, planes: Floats32) -> Floats32:
        """(n, blocks) float32: means over blocks of planes (n, h, w); two blocks may share a cell in
        parts."""
        means = self._weights[0] @ planes @ self._weights[1].T
        return np.asarray(means.reshape(len(planes), -1), np.float32)


def under_illumination(untouched: Floats32, coefficients: Floats32) -> Floats32:
    """The untouched gel under another illumination, (3, h, w) float32, grey levels up to 255.

    untouched : (3, h, w) float32, grey levels. coefficients : (3, 4) float32, from `IlluminationModel.fit`.
    """
    height, width = untouched.shape[1:]
    gain, slope_x, slope_y, offset = coefficients.T[:, :, None, None]
    gains = 1 + gain + slope_y * positions(height)[:, None] + slope_x * positions(width)
    return np.asarray(np.minimum(untouched * gains + offset, MAX_GREY), np.float32)


@lru_cache(maxsize=16)
def positions(count: int) -> Floats32:
    """(count,) float32: positions of pixels along a line, -0.5 to 0.5; cached, so do not modify."""
    return np.linspace(-0.5, 0.5, count, dtype=np.float32)


def _block_weights(blocks: int, count: int) -> Floats32:
    """(blocks, count) float32: weights of the `count` pixels of a line in the mean of each block."""
    edges = np.arange(blocks + 1) * (count / blocks)
    pixels = np.arange(count)
    covered = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return np.asarray(np.maximum(covered, 0) * (blocks / count), np.float32)


@kernel
def fit_light(
    cells: Floats32,
    row_weights: Floats32,
    column_weights: Floats32,
    blocks: Floats32,
    basis: Floats32,
    step: Floats32,
    shrink: Floats32,
    center: Floats32,
    coefficients: Floats32,
    saturated: float,
    max_steps: int,
    min_step: float,
    reject: float,
) -> None:
    """Least-squares steps with clipped residuals; fills `coefficients`, (3, 4), which are 0.

    cells : (3, h, w). row_weights, column_weights : (p, h) and (q, w), of the n = p q blocks. blocks :
    (3, 3, n): their means on the untouched gel; one over their brightness, 0 where they are unlit; and the
    limits of their residuals, which are 0 for blocks that are saturated, at this grey level. A gain starts at
    the median of the relative changes of lit, unsaturated blocks, or the largest one if all are saturated.
    basis, step : (3, 4, n), the model and its pseudo-inverse. shrink : (3, 4, 4), effect of the ridge on the
    coefficients in a step. center : (3,), divides the first three coefficients at the end. A fit ends after
    `max_steps`, or when no coefficient moves by `min_step`; the second one rejects residuals above `reject`
    times the limit.
    """
    reference, per_brightness, usual_limit = blocks
    means = (row_weights @ cells @ column_weights.T).reshape(reference.shape)
    excess = means - reference
    limit = np.where(means < saturated, usual_limit, 0)
    for ratios, lit, free, into in zip(
        excess * per_brightness, per_brightness > 0, limit > 0, coefficients, strict=True
    ):
        used = np.sort(ratios[lit & free])
        into[0] = used[len(used) // 2] if len(used) else ratios[lit].max(initial=0)
    for rejects in (False, True):
        for _ in range(max_steps):
            beyond = excess - (coefficients[:, None] @ basis)[:, 0]
            residual = np.clip(beyond, -limit, limit)
            if rejects:
                residual[np.abs(beyond) >= reject * limit] = 0
            change = (step @ residual[:, :, None])[:, :, 0] - (coefficients[:, None] @ shrink)[:, 0]
            coefficients += change
            if np.abs(change).max() < min_step:
                break
    coefficients[:, :3] /= center[:, None]
