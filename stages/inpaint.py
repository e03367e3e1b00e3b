"""Stage `inpaint`: the processed frame without its markers."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import Image, MarkerMask, Unmarked
from tactflow.vision.markers.inpaint import RADIUS_PX, remove_markers


class Inpaint(Stage):
    """Fill the markers from their surroundings.

    >>> import numpy as np
    >>> import tactflow
    >>> image = np.full((20, 20, 3), 128, np.uint8)
    >>> mask = np.zeros((20, 20), np.uint8)
    >>> image[8:12, 8:12], mask[8:12, 8:12] = 0, 255
    >>> tactflow.stage("inpaint").process(image, mask)[10, 10].tolist()
    [128, 128, 128]
    """

    memory = "pure"

    class Params(StageParams):
        """method : how markers are filled. radius : the neighbourhood they are filled from."""

        method: Literal["normalized", "telea", "ns", "none"] = Field(
            "normalized", description="normalized averages the gel around; telea and ns are OpenCV's, slow"
        )
        radius: float = Field(RADIUS_PX, gt=0, le=100, description="neighbourhood, processed px")

    params: Params

    def process(self, image: Image, marker_mask: MarkerMask) -> Unmarked:
        """The image with its markers filled."""
        return remove_markers(image, marker_mask, method=self.params.method, radius=self.params.radius)
