"""Stage `tracker`: current position of every marker of the reference frame."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.engine.frame import Frame
from tactflow.parameters import MarkParams
from tactflow.ports import Image, Valid
from tactflow.vision.markers.detection import Detection, NoMarkersError, detect_markers
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers

logger = logging.getLogger("tactflow")


class Tracker(Stage):
    """Follow the marker dots of the reference frame.

    A later reference in which no dots can be found, as in a dark or covered picture, leaves those of the
    earlier one.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> tracker = tactflow.stage("tracker")
    >>> [len(tracker.process(scene.frame(index)).position) for index in (0, 1)]
    [80, 80]
    """

    memory = "stateful"

    class Params(MarkParams):
        """Marks, and the limit of their motion."""

        max_displacement: float | None = Field(
            None,
            gt=0,
            description="farthest a mark may jump between two frames, processed px; "
            "null: 1.3 times the pitch; larger costs time and admits more confusion",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._tracker: MarkerTracker | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._earlier = self._tracker
        self._references: list[NDArray[np.uint8]] = []
        self._detection: Detection | None = None
        self._valid: NDArray[np.uint8] | None = None
        self._tracker = None

    def process(self, image: Image, frame: Frame, valid: Valid | None = None) -> Markers:
        """Position, status and standard error of every marker; the first frame serves as reference.

        Marks are searched for inside `valid`. Those that the reference did not show are appended. Raises
        NoMarkersError if the first reference shows none.
        """
        if self._tracker is None:
            self._tracker = self._begin(image, frame, valid)
        elif frame.reference:
            self._references.append(image)
        elif len(self._references) > 1 and self._detection is not None:
            # All reference frames have arrived: their mean has less noise than the first of them.
            self._tracker = self._tracker_of(self._detection)
            self._references = self._references[:1]
        return self._tracker.track(image)

    def _begin(self, image: Image, frame: Frame, valid: Valid | None) -> MarkerTracker:
        """The tracker of a new reference."""
        params = self.params
        try:
            self._detection = self.once(
                detect_markers, image, dot_radius=params.dot, polarity=params.polarity, valid=valid
            )
        except NoMarkersError:
            if self._earlier is None or frame.epoch == 0:
                raise
            logger.warning(
                "frame %d: the new reference shows no dots; those of the earlier one are followed", frame.seq
            )
            return self._earlier
        self._references, self._valid = [image], valid
        return self._tracker_of(self._detection)

    def _tracker_of(self, detection: Detection) -> MarkerTracker:
        farthest = self.params.max_displacement
        return MarkerTracker(self._references, detection, max_displacement=farthest, valid=self._valid)
