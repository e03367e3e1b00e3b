"""Plain version of the kernel of the illumination."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.illumination import CONVERGED, MAX_STEPS, NEVER, REJECT, SATURATED, fit_light
from tests.oracles.gains import Gain

Float = NDArray[np.float32]


def plain_fit_light(
    cells: Float,
    row_weights: Float,
    column_weights: Float,
    reference: Float,
    per_brightness: Float,
    usual_limit: Float,
    basis: Float,
    step: Float,
    shrink: Float,
    coefficients: Float,
) -> None:
    """Means over blocks, the median of their ratios, least-squares steps with clipped residuals, twice."""
    blocks = (row_weights @ cells @ column_weights.T).reshape(reference.shape)
    excess, below = blocks - reference, blocks < SATURATED
    limit = usual_limit * below
    for c in range(3):
        ratios = excess[c] * per_brightness[c]
        used = np.sort(ratios[(per_brightness[c] > 0) & below[c]])
        coefficients[c, 0] = used[len(used) // 2] if len(used) else ratios.max(initial=0)
    for reject in (NEVER, REJECT):
        for _ in range(MAX_STEPS):
            model = np.einsum("ck,ckn->cn", coefficients, basis)
            residual = np.clip(excess - model, -limit, limit)
            residual[np.abs(excess - model) >= reject * limit] = 0
            change = np.einsum("cn,ckn->ck", residual, step) - np.einsum("cj,cjk->ck", coefficients, shrink)
            coefficients += change
            if np.abs(change).max() < CONVERGED:
                break


GAINS = [Gain(fit_light, plain_fit_light, tolerance=1e-3)]
