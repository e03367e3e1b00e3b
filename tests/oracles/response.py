"""Plain version of the kernel of the light's response."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.response import sum_change
from tests.oracles.gains import Gain


def plain_sum_change(
    change: NDArray[np.float32],
    inside: NDArray[np.uint8],
    moments: NDArray[np.float64],
    colours: NDArray[np.float64],
) -> None:
    """Moments of the lengths over the channels, and products of the channels."""
    seen = change[:, ::2, ::2] * inside
    size = np.linalg.norm(seen, axis=0).astype(np.float64)
    y, x = np.indices(size.shape)
    moments[:] = [(size * power).sum() for power in (1, x, y, x * x, x * y, y * y)]
    flat = seen.reshape(3, -1).astype(np.float64)
    colours[:] = flat @ flat.T


# Sums up to 1e7, to the rounding of float32.
GAINS = [Gain(sum_change, plain_sum_change, tolerance=5.0)]
