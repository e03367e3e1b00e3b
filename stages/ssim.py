"""Stage `ssim`: detect contact by the structural similarity to the reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactPorts, Unmarked, Valid
from tactflow.vision.contact.similarity import structural_similarity
from tactflow.vision.contact.specks import without_specks
from tactflow.vision.markers.detection import to_gray


class Ssim(Stage):
    """Detect contact by the structural similarity to the reference, SSIM.

    Use it for objects with texture: it responds to edges and ridges, and little to changes of brightness.
    The smooth middle of a ball's contact is missing in its mask.

        difference: {use: ssim, similarity: 0.8}

    Z. Wang et al., "Image quality assessment: from error visibility to structural similarity", IEEE
    Transactions on Image Processing 13 (2004).

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> difference = tactflow.stage("ssim")
    >>> [difference.process(scene.frame(index)).touching for index in (0, 60)]
    [False, True]
    """

    memory = "stateful"

    class Params(StageParams):
        """The test of a pixel, and the smallest contact."""

        similarity: float = Field(0.9, ge=-1, le=1, description="contact is where it is lower")
        window: float = Field(1.5, gt=0, le=100, description="standard deviation of the window, px")
        opening: int = Field(9, ge=1, le=199, description="diameter of the smallest contact, px")

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._reference: NDArray[np.uint8] | None = None

    def process(self, unmarked: Unmarked, frame: Frame, valid: Valid | None = None) -> ContactPorts:
        """The contact mask of this frame; nothing outside of `valid` counts."""
        gray = to_gray(unmarked)
        if self._reference is None or frame.reference:
            self._reference = gray
        similarity = structural_similarity(gray, self._reference, self.params.window)
        changed = np.where(similarity < self.params.similarity, 255, 0).astype(np.uint8)
        mask = without_specks(changed, self.params.opening, valid)
        return ContactPorts(mask, bool(mask.any()))
