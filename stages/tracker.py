"""Stage `tracker`: where every marker of the reference frame is now."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.frame import Frame
from tactflow.engine.stage import StageParams
from tactflow.ports import Image
from tactflow.vision.markers import detect_markers
from tactflow.vision.tracking import MarkerTracker
from tactflow.vision.types import Markers


class Tracker:
    """Follow the marker dots of the reference frame (seed functions `marker_center`, `m.run`)."""

    memory = "stateful"

    class Params(StageParams):
        """dot, polarity : what the marks look like; found from the reference where not given."""

        method: Literal["grid", "seed"] = Field("grid", description="seed is the original's search")
        dot: float | None = Field(
            None, ge=1, le=200, description="radius of a mark, processed px; null finds it"
        )
        polarity: Literal["auto", "dark", "bright"] = Field("auto", description="marks against the gel")

    def __init__(self, params: Params) -> None:
        self._params = params
        self._tracker: MarkerTracker | None = None

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._tracker = None

    def process(self, image: Image, frame: Frame) -> Markers:
        """Position, status and standard error of every marker; the first frame serves as reference."""
        if self._tracker is None or frame.reference:
            detection = detect_markers(image, dot_radius=self._params.dot, polarity=self._params.polarity)
            self._tracker = MarkerTracker(image, detection)
        return self._tracker.track(image)
