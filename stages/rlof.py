"""Stage `rlof`: follow the dots by robust local optical flow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.engine.errors import StageError
from tactflow.parameters import MarkParams
from tactflow.ports import Image, Valid
from tactflow.vision.arrays import Flags, Floats32
from tactflow.vision.markers.detection import detect_markers, to_gray
from tactflow.vision.markers.points import FlowTracker
from tactflow.vision.types import Markers


class Rlof(Stage):
    """Follow the dots by robust local optical flow (RLOF), with a forward-backward check.

    Use it where the light over the dots changes with the contact and Lucas-Kanade loses them: it estimates
    gain and offset of each window, and gives less weight to pixels that differ.

        tracker: {use: rlof, max_error: 0.5}

    T. Senst, V. Eiselein, T. Sikora, "Robust local optical flow for feature tracking", IEEE Transactions on
    Circuits and Systems for Video Technology 22 (2012).

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> tracker = tactflow.stage("rlof")
    >>> [len(tracker.process(scene.frame(index)).position) for index in (0, 1)]
    [80, 80]
    """

    memory = "stateful"

    class Params(MarkParams):
        """The window around a dot, and the check."""

        window: int | None = Field(
            None, ge=9, le=401, description="side of the window, px; null: four radii of a dot, and one"
        )
        max_error: float = Field(
            1.0, gt=0, le=100, description="px; a dot that comes back farther from its origin is lost"
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        if not hasattr(cv2, "optflow"):
            raise StageError("rlof needs OpenCV's extra modules: pip install opencv-contrib-python-headless")
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
            self._settings = cv2.optflow.RLOFOpticalFlowParameter.create()
            self._settings.setSupportRegionType(cv2.optflow.SR_FIXED)
            self._settings.setLargeWinSize(params.window or max(9, 2 * round(2 * found.dot_radius) + 1))
            self._settings.setUseInitialFlow(True)
            # It takes nearly all of the time, and fails together with an initial flow.
            self._settings.setUseGlobalMotionPrior(False)
            self._tracker = FlowTracker(gray, found.centers, found.dot_radius, self._flow, params.max_error)
        return self._tracker.track(gray)

    def _flow(
        self, before: NDArray[np.uint8], after: NDArray[np.uint8], points: Floats32, start: Floats32
    ) -> tuple[Floats32, Flags]:
        # A row of points: columns come back where they were.
        position, found, _ = cv2.optflow.calcOpticalFlowSparseRLOF(
            before, after, points[None].copy(), start[None].copy(), rlofParam=self._settings
        )
        return np.asarray(position[0], np.float32), found.ravel() > 0
