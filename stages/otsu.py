"""Stage `otsu`: detect contact by the absolute difference from the reference, split by Otsu's threshold."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactPorts, Unmarked, Valid
from tactflow.vision.contact.specks import without_specks


class Otsu(Stage):
    """Detect contact by the absolute difference from the reference and Otsu's threshold.

    Use it as the usual first script, and where the strength of the response differs from press to press. Otsu
    splits every picture, so `least` is the lowest threshold that separates gel from contact.

        difference: {use: otsu, least: 8}

    N. Otsu, "A threshold selection method from gray-level histograms", IEEE Transactions on Systems, Man, and
    Cybernetics 9 (1979).

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> difference = tactflow.stage("otsu")
    >>> [difference.process(scene.frame(index)).touching for index in (0, 60)]
    [False, True]
    """

    memory = "stateful"

    class Params(StageParams):
        """Smoothing, and what counts as a contact."""

        least: float = Field(10.0, ge=0, le=255, description="least threshold of a contact, grey levels")
        blur: float = Field(2.0, gt=0, le=100, description="standard deviation of the smoothing, px")
        opening: int = Field(9, ge=1, le=199, description="diameter of the smallest contact, px")

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._reference: NDArray[np.uint8] | None = None

    def process(self, unmarked: Unmarked, frame: Frame, valid: Valid | None = None) -> ContactPorts:
        """The contact mask of this frame; nothing outside of `valid` counts."""
        if self._reference is None or frame.reference:
            self._reference = unmarked
        change = cv2.absdiff(unmarked, self._reference).max(axis=2)
        change = cv2.GaussianBlur(change, (0, 0), self.params.blur)
        counted = change if valid is None else change[valid > 0]
        threshold = cv2.threshold(counted, 0, 255, cv2.THRESH_OTSU)[0] if counted.size else 255.0
        changed = np.where(change > max(threshold, self.params.least), 255, 0).astype(np.uint8)
        mask = without_specks(changed, self.params.opening, valid)
        if threshold < self.params.least:
            mask[:] = 0
        return ContactPorts(mask, bool(mask.any()))
