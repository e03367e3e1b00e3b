"""Stage `marker_mask`: where markers cover the gel."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.stage import StageParams
from tactflow.ports import Image, MarkerMask
from tactflow.vision.marker_mask import marker_mask
from tactflow.vision.seed_contact import seed_marker_mask


class MarkerMaskStage:
    """Mask of the marker dots (seed function `mask_marker`)."""

    memory = "pure"

    class Params(StageParams):
        """method : how markers are found. dot, polarity, contrast : what they look like (`dog` only)."""

        method: Literal["dog", "seed"] = Field("dog", description="dog scales with the dot; seed is literal")
        dot: float = Field(4.0, gt=0, le=100, description="radius of a dot, processed px")
        polarity: Literal["dark", "bright"] = Field("dark", description="dots against the gel")
        contrast: float = Field(6.0, gt=0, le=255, description="least difference to the gel, grey levels")

    def __init__(self, params: Params) -> None:
        self._params = params

    def process(self, image: Image) -> MarkerMask:
        """255 where a marker covers the gel."""
        params = self._params
        if params.method == "seed":
            return seed_marker_mask(image)
        return marker_mask(image, params.dot, polarity=params.polarity, contrast=params.contrast)
