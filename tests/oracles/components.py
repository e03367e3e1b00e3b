"""Plain version of the kernel of the connected components."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.contact.components import close_changes
from tests.oracles.gains import Gain


def plain_close_changes(squared: NDArray[np.float32], weak: float, closed: NDArray[np.uint8]) -> None:
    """Morphological closing of what is above the threshold."""
    above = (squared > weak).view(np.uint8)
    closed[:] = cv2.morphologyEx(above, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)).reshape(closed.shape)


GAINS = [Gain(close_changes, plain_close_changes)]
