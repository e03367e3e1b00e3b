"""Plain version of the kernel of the illumination."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.illumination import CONVERGED, MAX_STEPS, NEVER, REJECT, fit_robustly
from tests.oracles.gains import Gain

Float = NDArray[np.float32]


def plain_fit_robustly(
    excess: Float, basis: Float, step: Float, shrink: Float, limit: Float, coefficients: Float
) -> None:
    """Least-squares steps with clipped residuals, twice."""
    for reject in (NEVER, REJECT):
        for _ in range(MAX_STEPS):
            model = np.einsum("ck,ckn->cn", coefficients, basis)
            residual = np.clip(excess - model, -limit, limit)
            residual[np.abs(excess - model) >= reject * limit] = 0
            change = np.einsum("cn,ckn->ck", residual, step) - np.einsum("cj,cjk->ck", coefficients, shrink)
            coefficients += change
            if np.abs(change).max() < CONVERGED:
                break


GAINS = [Gain(fit_robustly, plain_fit_robustly, tolerance=1e-3)]
