"""Stage `knn`: detect contact by the nearest samples of each pixel of the untouched gel."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactPorts, Unmarked, Valid
from tactflow.vision.contact.specks import without_specks

LEARNING_REPETITIONS: Final = 20
"""Times that the first frame is learned: OpenCV needs seven or more until its samples are filled."""

MIN_LEARNING_RATE: Final = 1e-9
"""Weight of a new frame that changes nothing in a run of years. With 0, OpenCV divides by it and forgets the
reference within four frames."""


class Knn(Stage):
    """Detect contact by background subtraction with k nearest neighbours.

    Use it for a fixed distance of colours from a reference that has more than one state, such as lamps that
    flicker. With a `learning_rate` it follows slow light, and forgets contacts that last.

        difference: {use: knn, distance: 12}

    Z. Zivkovic, F. van der Heijden, "Efficient adaptive density estimation per image pixel for the task of
    background subtraction", Pattern Recognition Letters 27 (2006).

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> difference = tactflow.stage("knn")
    >>> [difference.process(scene.frame(index)).touching for index in (0, 60)]
    [False, True]
    """

    memory = "stateful"

    class Params(StageParams):
        """The test of a pixel, and the smallest contact."""

        distance: float = Field(20.0, gt=0, le=442, description="to the gel's colour, grey levels")
        learning_rate: float = Field(
            0.0, ge=0, le=1, description="weight of a new frame after the reference; 0 keeps the reference"
        )
        opening: int = Field(9, ge=1, le=199, description="diameter of the smallest contact, px")

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._background = cv2.createBackgroundSubtractorKNN(
            dist2Threshold=self.params.distance**2, detectShadows=False
        )
        self._known = False

    def process(self, unmarked: Unmarked, frame: Frame, valid: Valid | None = None) -> ContactPorts:
        """The contact mask of this frame; nothing outside of `valid` counts."""
        if not self._known or frame.reference:
            for _ in range(1 if self._known else LEARNING_REPETITIONS):
                self._background.apply(unmarked, learningRate=-1)
            self._known = True
        rate = max(self.params.learning_rate, MIN_LEARNING_RATE)
        changed = np.asarray(self._background.apply(unmarked, learningRate=rate), np.uint8)
        mask = without_specks(changed, self.params.opening, valid)
        return ContactPorts(mask, bool(mask.any()))
