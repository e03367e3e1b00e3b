"""Stage `nearest_dots`: link the dots detected in each frame to the nearest ones of the frame before."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.parameters import MarkParams
from tactflow.ports import Image, Valid
from tactflow.vision.markers.detection import NoMarkersError, detect_markers
from tactflow.vision.markers.points import NearestTracker
from tactflow.vision.types import Markers


class NearestDots(Stage):
    """Link the dots detected in each frame to the nearest ones of the frame before.

    Use it as the simplest tracker, where dots move by less than half their distance between frames, and as
    a start for a tracker with a detector of your own. A dot that is hidden for a while may come back as
    another.

        tracker: {use: nearest_dots, max_displacement: 12}

    J. C. Crocker, D. G. Grier, "Methods of digital video microscopy for colloidal studies", Journal of
    Colloid and Interface Science 179 (1996), for the linking of detections.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> tracker = tactflow.stage("nearest_dots")
    >>> [len(tracker.process(scene.frame(index)).position) for index in (0, 1)]
    [80, 80]
    """

    memory = "stateful"

    class Params(MarkParams):
        """How far a dot may go."""

        max_displacement: float | None = Field(
            None,
            gt=0,
            description="farthest a dot may move between two frames, processed px; null: half the distance "
            "of neighbouring dots",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._tracker: NearestTracker | None = None

    def process(self, image: Image, valid: Valid | None = None) -> Markers:
        """Position and status of every dot of the first frame."""
        params = self.params
        if self._tracker is None:
            found = self.once(
                detect_markers, image, dot_radius=params.dot, polarity=params.polarity, valid=valid
            )
            self._radius, self._polarity = found.dot_radius, found.polarity
            self._tracker = NearestTracker(found.centers, params.max_displacement or found.pitch / 2)
            return self._tracker.link(found.centers)
        try:
            found = detect_markers(image, dot_radius=self._radius, polarity=self._polarity, valid=valid)
        except NoMarkersError:
            return self._tracker.link(np.zeros((0, 2)))
        return self._tracker.link(found.centers)
