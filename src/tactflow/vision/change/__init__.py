"""Tests on raw frames, before any processing.

`rest` decides which results could differ from those of earlier frames. `settling` searches the first frames
of a source for the untouched gel in steady light. `damage` finds pictures that show no gel, or that were
damaged on their way from the camera.
"""

from tactflow.vision.change.damage import DamageTest, shows_gel
from tactflow.vision.change.rest import RestTest
from tactflow.vision.change.settling import Settling

__all__ = ["DamageTest", "RestTest", "Settling", "shows_gel"]
