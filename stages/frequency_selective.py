"""Stage `frequency_selective`: the processed frame without its markers, by extrapolation of frequencies."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.errors import StageError
from tactflow.ports import Image, MarkerMask, Unmarked


class FrequencySelective(Stage):
    """Fill the markers by frequency selective reconstruction, which continues the texture around them.

    Use it for pictures of single presses whose texture matters, such as a weave; at half a second or more a
    frame it is too slow for anything else.

        inpaint: {use: frequency_selective, quality: best}

    N. Genser et al., "Spectral constrained frequency selective extrapolation for rapid image error
    concealment", IWSSIP 2018; J. Seiler et al., "Resampling images to a regular grid from a non-regular
    subset of pixel positions using frequency selective reconstruction", IEEE Transactions on Image
    Processing 24 (2015).

    >>> import tactflow
    >>> image = np.full((20, 20, 3), 128, np.uint8)
    >>> mask = np.zeros((20, 20), np.uint8)
    >>> image[8:12, 8:12], mask[8:12, 8:12] = 0, 255
    >>> tactflow.stage("frequency_selective").process(image, mask)[10, 10].tolist()
    [128, 128, 128]
    """

    memory = "pure"

    class Params(StageParams):
        """How long it may take."""

        quality: Literal["fast", "best"] = Field("fast", description="best takes ten times as long as fast")

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        if not hasattr(cv2, "xphoto"):
            raise StageError(
                "frequency_selective needs OpenCV's extra modules: pip install opencv-contrib-python-headless"
            )

    def process(self, image: Image, marker_mask: MarkerMask) -> Unmarked:
        """The image with its markers filled."""
        filled = image.copy()
        # It fails where every pixel is hidden, as nothing is known then.
        if marker_mask.any() and not marker_mask.all():
            best = self.params.quality == "best"
            method = cv2.xphoto.INPAINT_FSR_BEST if best else cv2.xphoto.INPAINT_FSR_FAST
            known = np.where(marker_mask > 0, 0, 255).astype(np.uint8)
            cv2.xphoto.inpaint(image, known, filled, method)
        return np.asarray(np.where(marker_mask[..., None] > 0, filled, image), np.uint8)
