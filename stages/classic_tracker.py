"""Stage `classic_tracker`: the original script's tracking of the dots, a tree search."""

from __future__ import annotations

from tactflow.classic.tracker import GridTracker
from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import Image
from tactflow.vision.types import Markers


class ClassicTracker(Stage):
    """Match the dots of each frame to the grid of the first one by depth-first search, as in the original
    script.

    Use it as the baseline, for a grid of rows and columns without gaps.

        tracker: {use: classic_tracker}

    The script's `marker_center` and its search `m`.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> tracker = tactflow.stage("classic_tracker")
    >>> [len(tracker.process(scene.frame(index)).position) for index in (0, 1)]
    [80, 80]
    """

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the grid; the next frame defines it."""
        self._tracker: GridTracker | None = None

    def process(self, image: Image) -> Markers:
        """Position and status of every marker of the first frame."""
        if self._tracker is None:
            self._tracker = GridTracker(image)
        return self._tracker.track(image)
