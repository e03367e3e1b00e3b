"""Plain version of the kernel of the light's response."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.response import LARGEST_GAIN, LEAST, LONG, ROUND

Float = NDArray[np.float32]


def plain_weigh_colours(change: Float, inside: NDArray[np.uint8], response: Float) -> None:
    """Covariances of the places, weighed by the length of the change, and of its channels."""
    each = len(change) // (2 * len(inside))
    counts = (inside > 0).repeat(each, axis=0).repeat(each, axis=1)
    seen = change.reshape(len(change), -1, 3)[::2, ::2][counts].astype(np.float64)
    size = np.linalg.norm(seen, axis=1)
    response[:] = 1, 0, 0, 0
    if not size.sum() > 0:
        return
    across, along = np.linalg.eigvalsh(np.cov(np.nonzero(counts), aweights=size, ddof=0))
    if not LEAST / 2 < along < LONG * across:
        return
    elongation = along / across
    powers, directions = np.linalg.eigh(seen.T @ seen)
    second, first = powers[1:]
    if second * elongation >= first:
        return
    raised = min(first / max(second * elongation, 1e-6 * first), LARGEST_GAIN**2)
    gain = raised ** min((LONG - elongation) / (LONG - ROUND), 1)
    scale = powers.sum() / (gain * powers.sum() - (gain - 1) * first)
    strongest = directions[:, 2] * np.copysign(1, directions[2, 2])
    response[0], response[1:] = gain * scale, strongest * np.sqrt((gain - 1) * scale)
