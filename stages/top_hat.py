"""Stage `top_hat`: mask of the dots by a morphological top-hat."""

from __future__ import annotations

import math

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.parameters import MarkParams
from tactflow.ports import Image, MarkerMask, Valid
from tactflow.vision.markers.detection import detect_markers, to_gray
from tactflow.vision.markers.mask import Dot, find_dot


class TopHat(Stage):
    """Mask of the dots by a top-hat: what is narrower than a disc, and darker or brighter than around.

    Use it for marks of one width under uneven light; it keeps their outline to the pixel. Thin folds of the
    gel are in its mask, too.

        marker_mask: {use: top_hat, contrast: 12}

    F. Meyer, "Contrast feature extraction", Special Issues of Practical Metallography, 1977.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> mask = tactflow.stage("top_hat").process(scene.frame(0))
    >>> bool(0.02 < (mask > 0).mean() < 0.3)
    True
    """

    memory = "stateful"

    class Params(MarkParams):
        """The threshold."""

        contrast: float | None = Field(
            None,
            ge=1,
            le=255,
            description="least difference to the gel around, grey levels; null: a quarter of the dots'",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the dots; a new reference follows."""
        self._known = False
        self._dot: Dot | None = None

    def process(self, image: Image, valid: Valid | None = None) -> MarkerMask:
        """255 where a dot covers the gel; all 0 where the first frame showed none."""
        params = self.params
        if not self._known:
            self._known = True
            detect = self.once.keeping(detect_markers)
            self._dot = find_dot(
                image, radius=params.dot, polarity=params.polarity, valid=valid, detect=detect
            )
        if self._dot is None:
            return np.zeros(image.shape[:2], np.uint8)
        # The soft border of a dot is outside of its radius.
        side = 2 * math.ceil(max((self._dot.radius, *self._dot.others)) + 2) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        hat = cv2.MORPH_TOPHAT if self._dot.polarity == "bright" else cv2.MORPH_BLACKHAT
        height = cv2.morphologyEx(to_gray(image), hat, disc)
        return np.where(height > (params.contrast or self._dot.contrast), 255, 0).astype(np.uint8)
