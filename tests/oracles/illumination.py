"""Plain versions of the kernels of the illumination."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.illumination import (
    MAX_STEPS,
    MIN_STEP_GREY,
    NO_REJECTION_RATIO,
    REJECT_CLIP_RATIO,
    SATURATED,
)

Float = NDArray[np.float32]


def plain_compare_blocks(
    cells: Float,
    row_weights: Float,
    column_weights: Float,
    reference: Float,
    per_brightness: Float,
    usual_limit: Float,
    excess: Float,
    limit: Float,
    coefficients: Float,
) -> None:
    """Means over blocks, and the median of their relative changes."""
    blocks = (row_weights @ cells @ column_weights.T).reshape(reference.shape)
    below = blocks < SATURATED
    excess[:] = blocks - reference
    limit[:] = usual_limit * below
    for c in range(3):
        ratios = excess[c] * per_brightness[c]
        used = np.sort(ratios[(per_brightness[c] > 0) & below[c]])
        coefficients[c, 0] = used[len(used) // 2] if len(used) else ratios.max(initial=0)


def plain_fit_robustly(
    excess: Float, basis: Float, step: Float, shrink: Float, limit: Float, center: Float, coefficients: Float
) -> None:
    """Least-squares steps with clipped residuals, twice."""
    for reject in (NO_REJECTION_RATIO, REJECT_CLIP_RATIO):
        for _ in range(MAX_STEPS):
            model = np.einsum("ck,ckn->cn", coefficients, basis)
            residual = np.clip(excess - model, -limit, limit)
            residual[np.abs(excess - model) >= reject * limit] = 0
            change = np.einsum("cn,ckn->ck", residual, step) - np.einsum("cj,cjk->ck", coefficients, shrink)
            coefficients += change
            if np.abs(change).max() < MIN_STEP_GREY:
                break
    coefficients[:, :3] /= center[:, None]
