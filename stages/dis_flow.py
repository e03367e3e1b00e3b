"""Stage `dis_flow`: follow the dots by dense inverse search, a flow of every pixel."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.parameters import MarkParams
from tactflow.ports import Image, Valid
from tactflow.vision.arrays import Flags, Floats32
from tactflow.vision.markers.detection import detect_markers, to_gray
from tactflow.vision.markers.points import FlowTracker
from tactflow.vision.types import Markers

_PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


class DisFlow(Stage):
    """Follow the dots by DIS optical flow, sampled at the dots, with a forward-backward check.

    Use it where the gel has texture between the dots, or as a start for a flow of every pixel. Its
    smoothness pulls dots towards their neighbours: a tenth of a pixel or more.

        tracker: {use: dis_flow, preset: medium}

    T. Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> tracker = tactflow.stage("dis_flow")
    >>> [len(tracker.process(scene.frame(index)).position) for index in (0, 1)]
    [80, 80]
    """

    memory = "stateful"

    class Params(MarkParams):
        """Quality of the flow, and the check."""

        preset: Literal["ultrafast", "fast", "medium"] = Field(
            "fast", description="OpenCV's; medium takes five times as long as fast, with a third of its error"
        )
        max_error: float = Field(
            1.0, gt=0, le=100, description="px; a dot that comes back farther from its origin is lost"
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._dense = cv2.DISOpticalFlow.create(_PRESETS[params.preset])
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._tracker: FlowTracker | None = None

    def process(self, image: Image, valid: Valid | None = None) -> Markers:
        """Position and status of every dot of the first frame."""
        params, gray = self.params, to_gray(image)
        if self._tracker is None:
            found = self.once(
                detect_markers, image, dot_radius=params.dot, polarity=params.polarity, valid=valid
            )
            self._tracker = FlowTracker(gray, found.centers, found.dot_radius, self._flow, params.max_error)
        return self._tracker.track(gray)

    def _flow(
        self, before: NDArray[np.uint8], after: NDArray[np.uint8], points: Floats32, _: Floats32
    ) -> tuple[Floats32, Flags]:
        flow = self._dense.calc(before, after, None)  # type: ignore[call-overload]
        x, y = (np.ascontiguousarray(axis)[:, None] for axis in points.T)
        moved = cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(points + moved[:, 0], np.float32), np.full(len(points), True)
