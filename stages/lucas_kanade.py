"""Stage `lucas_kanade`: follow the dots by the pyramidal optical flow of Lucas and Kanade."""

from __future__ import annotations

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


class LucasKanade(Stage):
    """Follow the dots by pyramidal Lucas-Kanade, with a forward-backward check.

    Use it as the yardstick that every reader knows, and for marks of any shape that move by less than half
    their distance between frames. It confuses dots that jump farther, and knows no standard errors.

        tracker: {use: lucas_kanade, max_error: 0.5}

    J.-Y. Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", Intel, 2000.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> tracker = tactflow.stage("lucas_kanade")
    >>> [len(tracker.process(scene.frame(index)).position) for index in (0, 1)]
    [80, 80]
    """

    memory = "stateful"

    class Params(MarkParams):
        """The window around a dot, and the check."""

        window: int | None = Field(
            None, ge=3, le=401, description="side of the window, px; null: four radii of a dot, and one"
        )
        levels: int = Field(
            3, ge=0, le=10, description="pyramid levels above the picture; more reach farther"
        )
        max_error: float = Field(
            1.0, gt=0, le=100, description="px; a dot that comes back farther from its origin is lost"
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
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
            self._side = params.window or 2 * round(2 * found.dot_radius) + 1
            self._tracker = FlowTracker(gray, found.centers, found.dot_radius, self._flow, params.max_error)
        return self._tracker.track(gray)

    def _flow(
        self, before: NDArray[np.uint8], after: NDArray[np.uint8], points: Floats32, start: Floats32
    ) -> tuple[Floats32, Flags]:
        position, found, _ = cv2.calcOpticalFlowPyrLK(
            before,
            after,
            points,
            start.copy(),
            winSize=(self._side, self._side),
            maxLevel=self.params.levels,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(position, np.float32), found[:, 0] > 0
