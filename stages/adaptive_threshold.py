"""Stage `adaptive_threshold`: mask of the dots by a threshold that follows the brightness around."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.parameters import MarkParams
from tactflow.ports import Image, MarkerMask, Valid
from tactflow.vision.markers.detection import detect_markers, to_gray
from tactflow.vision.markers.mask import Dot, find_dot


class AdaptiveThreshold(Stage):
    """Mask of the dots by an adaptive threshold on the brightness.

    Use it for marks of any shape, such as lines, squares or characters. The borders of a contact are in its
    mask, too.

        marker_mask: {use: adaptive_threshold, contrast: 12}

    P. D. Wellner, "Adaptive thresholding for the DigitalDesk", Xerox EuroPARC, 1993.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> mask = tactflow.stage("adaptive_threshold").process(scene.frame(0))
    >>> bool(0.02 < (mask > 0).mean() < 0.3)
    True
    """

    memory = "stateful"

    class Params(MarkParams):
        """The window, and the threshold."""

        window: int | None = Field(
            None, ge=3, le=801, description="side of the window, px; null: eight radii of a dot, and one"
        )
        contrast: float | None = Field(
            None,
            ge=1,
            le=255,
            description="least difference to the window's mean, grey levels; null: a quarter of the dots'",
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
        gray = to_gray(image)
        side = (params.window or 2 * round(4 * self._dot.radius)) | 1
        mask = cv2.adaptiveThreshold(
            gray if self._dot.polarity == "bright" else 255 - gray,
            255,
            cv2.ADAPTIVE_THRESH_MEAN_C,
            cv2.THRESH_BINARY,
            side,
            -(params.contrast or self._dot.contrast),
        )
        return np.asarray(mask, np.uint8)
