"""Plain version of the kernel of the connected components."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.components import close_changes
from tests.oracles.gains import Gain


def plain_close_changes(
    squared: NDArray[np.float32], weak: float, closed: NDArray[np.uint8]
) -> tuple[int, ...]:
    """Morphological closing of what is above the threshold; its only part, if no row of that has a gap."""
    above = (squared > weak).view(np.uint8)
    closed[:] = cv2.morphologyEx(above, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).reshape(closed.shape)
    count, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    ends = np.diff(closed.astype(np.int8), axis=1, prepend=0, append=0) == 1
    return tuple(stats[1].tolist()) if count == 2 and ends.sum(axis=1).max() == 1 else (0,) * 5


GAINS = [Gain(close_changes, plain_close_changes)]
