"""Plain version of the kernel that judges what the tracker has measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.tracking import (
    DOUBTFUL,
    INCOMPLETE,
    STEEP_STRAIN,
    SURE,
    check_marks,
    trusted,
)
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def plain_check_marks(
    position: FloatArray,
    before: FloatArray,
    gain: NDArray[np.float32],
    r_squared: NDArray[np.float32],
    edges: NDArray[np.int64],
    strain: FloatArray,
    steepest: FloatArray,
    seen_before: BoolArray,
    longest: float,
    restless: float,
    seen: BoolArray,
) -> int:
    """The same in numpy."""
    move = np.linalg.norm(position - before, axis=1)
    seen[:] = trusted(gain, r_squared) & (move < longest)
    if seen.all() and strain.max(initial=0.0) < STEEP_STRAIN:
        return SURE
    rough = edges[strain > steepest]
    if (seen_before & ~seen).any() or seen[rough].all(axis=1).any():
        return DOUBTFUL
    return DOUBTFUL if move[seen].max(initial=0.0) > restless else INCOMPLETE


GAINS = [Gain(check_marks, plain_check_marks)]
