"""Stage `marker_mask`: mask of the markers."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import Image, MarkerMask, Valid
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask


class MarkerMaskStage(Stage):
    """Mask of the marker dots; their size and polarity are found in the first frame.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> mask = tactflow.stage("marker_mask").process(scene.frame(0))
    >>> bool(0.02 < (mask > 0).mean() < 0.3)
    True
    """

    memory = "stateful"

    class Params(StageParams):
        """What the dots look like."""

        dot: Literal["auto"] | Annotated[float, Field(ge=1, le=100)] = Field(
            "auto", description="radius of a dot, processed px, 1 to 100; auto finds it in the first frame"
        )
        polarity: Literal["auto", "dark", "bright"] = Field("auto", description="dots against the gel")
        contrast: Literal["auto"] | Annotated[float, Field(ge=1, le=255)] = Field(
            "auto",
            description="least difference to the gel, grey levels, 1 to 255; auto: a quarter of the dots'",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._dot: Dot | None = None
        self._known = False

    def reset(self) -> None:
        """Forget the dots; a new reference follows."""
        self._dot, self._known = None, False

    def process(self, image: Image, valid: Valid | None = None) -> MarkerMask:
        """255 where a marker covers the gel; all 0 where the first frame showed no markers.

        Their appearance is learned inside `valid`.
        """
        if not self._known:
            self._dot, self._known = self._find(image, valid), True
        if self._dot is None:
            return np.zeros(image.shape[:2], np.uint8)
        return marker_mask(image, self._dot)

    def _find(self, image: Image, valid: Valid | None) -> Dot | None:
        params = self.params
        radius = None if params.dot == "auto" else params.dot
        detect = self.once.keeping(detect_markers)
        found = find_dot(image, radius=radius, polarity=params.polarity, valid=valid, detect=detect)
        if found is None or params.contrast == "auto":
            return found
        return replace(found, contrast=params.contrast)
