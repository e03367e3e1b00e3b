"""The network that says how likely each place of a gel is in contact.

A convolutional encoder and decoder (U-Net; Ronneberger, Fischer, Brox, MICCAI 2015) with 72,000 weights,
trained on the random scenes of `benchmarks/wide.py` by `benchmarks/train_contact.py`, and on no recording.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats32
from tactflow.vision.contact.change import Change

WEIGHTS: Final = "contact.onnx"
"""File beside this one."""


@cache
def _weights() -> NDArray[np.uint8]:
    return np.frombuffer(files("tactflow.vision.contact").joinpath(WEIGHTS).read_bytes(), np.uint8)


class ContactNetwork:
    """Evaluates the network with OpenCV; one instance for each thread.

    >>> from tactflow.vision.contact.change import Untouched
    >>> gel = np.full((48, 64, 3), 120, np.uint8)
    >>> ContactNetwork()(Untouched(gel).change(gel)).shape
    (96, 128)
    """

    def __init__(self) -> None:
        self._network = cv2.dnn.readNetFromONNX(_weights())

    def __call__(self, change: Change) -> Floats32:
        """(h, w) float32: log odds of contact for each cell of the grid."""
        self._network.setInput(change.planes[None])
        high, wide = change.size
        return np.array(self._network.forward()[0, 0, :high, :wide], np.float32)
