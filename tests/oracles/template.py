"""Plain version of the kernel that aligns marks with their templates."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.template import (
    CONVERGED,
    LEAST_DIVISOR,
    LEAST_RESIDUAL,
    PHASES,
    ROUNDS,
    SAMPLING_ERROR,
    STEP_GAIN,
    STEP_R_SQUARED,
    align_marks,
)
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]


def plain_align_marks(
    image: NDArray[np.uint8],
    start: FloatArray,
    marks: IntArray,
    weights: NDArray[np.int16],
    terms: Float32Array,
    disc: IntArray,
    reach: int,
    radius: float,
    position: FloatArray,
    found: Float32Array,
) -> None:
    """Steps of all marks together, as products of matrices; those that are done take part no longer."""
    gray = image[:, :, 0] if image.shape[2] == 1 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    del reach
    models = (weights, terms, disc, radius)
    position[:], found[:] = _step(gray, start, marks, *models)
    active = np.arange(len(marks))
    start = start.copy()
    for _ in range(ROUNDS):
        far = ((position[active] - start[active]) ** 2).sum(axis=1) > CONVERGED**2
        active = active[far & (found[1, active] > STEP_R_SQUARED) & (found[0, active] > STEP_GAIN)]
        start[active] = position[active]
        position[active], found[:, active] = _step(gray, start[active], marks[active], *models)


def _step(
    gray: NDArray[np.uint8],
    start: FloatArray,
    marks: IntArray,
    weights: NDArray[np.int16],
    terms: Float32Array,
    disc: IntArray,
    radius: float,
) -> tuple[FloatArray, Float32Array]:
    """One least-squares step from the phase nearest to the starting points."""
    phases, longest = PHASES, np.float32(radius)
    count, pixels = len(weights) // phases**2, disc.shape[1]
    limits = np.array([gray.shape[1] - 1, gray.shape[0] - 1])
    phase = (np.clip(start, 0, limits) * phases + phases / 2).astype(np.int64)
    which = phase % phases @ np.array([1, phases]) * count + marks
    at = np.clip(phase[:, :, None] // phases + disc, 0, limits[:, None])
    patch = np.zeros((len(marks), weights.shape[2]))
    patch[:, :pixels] = gray[at[:, 1], at[:, 0]].astype(np.float64) - 128
    term = terms[which].astype(np.float64)
    sums = np.matmul(weights[which].astype(np.float64), patch[:, :, None])[:, :, 0] * term[:, 10:15]
    theta, slope = sums[:, :3], sums[:, 3:]
    explained = np.vecdot(np.matmul(term[:, :9].reshape(-1, 3, 3), theta[:, :, None])[:, :, 0], theta)
    safe = np.maximum(theta[:, 0], LEAST_DIVISOR)
    step = np.clip(theta[:, 1:] / safe[:, None], -longest, longest)
    contrast = np.vecdot(patch, patch) - patch.sum(axis=1) ** 2 / pixels - np.vecdot(slope, slope)
    rest = np.maximum(contrast - explained, LEAST_RESIDUAL)
    stderr = np.sqrt(rest * term[:, 9] / (safe * safe) + np.float32(SAMPLING_ERROR**2))
    found = np.stack([theta[:, 0], explained / (explained + rest), stderr]).astype(np.float32)
    return (phase + 0.5) / phases - 0.5 + step, found


# Some ten operations in float32 after sums that are exact: relative errors of 1e-6.
GAINS = [Gain(align_marks, plain_align_marks, tolerance=2e-5)]
