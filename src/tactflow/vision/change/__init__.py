"""Tests on raw frames, before any processing.

`rest` decides which results could differ from those of earlier frames. `settling` searches the first frames
of a source for the untouched gel in steady light.
"""

from tactflow.vision.change.rest import RestTest
from tactflow.vision.change.settling import Settling

__all__ = ["RestTest", "Settling"]
