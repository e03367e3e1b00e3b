"""Stage `mog2`: detect contact by a mixture of Gaussians for each pixel of the untouched gel."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactPorts, Unmarked, Valid
from tactflow.vision.contact.specks import without_specks


class Mog2(Stage):
    """Detect contact by background subtraction with a mixture of Gaussians, MOG2.

    Use it where the reference has many frames, so that each pixel's own noise is known, and where the light
    flickers between a few states. With a `learning_rate` it follows slow light, and forgets contacts that
    last.

        difference: {use: mog2, threshold: 25}

    Z. Zivkovic, F. van der Heijden, "Efficient adaptive density estimation per image pixel for the task of
    background subtraction", Pattern Recognition Letters 27 (2006).

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> difference = tactflow.stage("mog2")
    >>> [difference.process(scene.frame(index)).touching for index in (0, 60)]
    [False, True]
    """

    memory = "stateful"

    class Params(StageParams):
        """The test of a pixel, and the smallest contact."""

        threshold: float = Field(
            16.0, gt=0, le=1e4, description="squared distance to the gel's colour, in variances"
        )
        learning_rate: float = Field(
            0.0, ge=0, le=1, description="weight of a new frame after the reference; 0 keeps the reference"
        )
        opening: int = Field(9, ge=1, le=199, description="diameter of the smallest contact, px")

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._background = cv2.createBackgroundSubtractorMOG2(
            varThreshold=self.params.threshold, detectShadows=False
        )
        self._known = False

    def process(self, unmarked: Unmarked, frame: Frame, valid: Valid | None = None) -> ContactPorts:
        """The contact mask of this frame; nothing outside of `valid` counts."""
        if not self._known or frame.reference:
            # -1: OpenCV's choice, the mean of the reference frames so far.
            self._background.apply(unmarked, learningRate=-1 if self._known else 1)
            self._known = True
        changed = self._background.apply(unmarked, learningRate=self.params.learning_rate)
        mask = without_specks(np.asarray(changed, np.uint8), self.params.opening, valid)
        return ContactPorts(mask, bool(mask.any()))
