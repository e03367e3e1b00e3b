"""Stage `classic_difference`: the original script's contact mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.classic.functions import difference
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactPorts, Unmarked


class ClassicDifference(Stage):
    """Contact where the gel is brighter by 14 grey levels in all channels, as in the original script.

    Use it as the baseline. It finds nothing on gels that change colour or darken.

        difference: {use: classic_difference}

    The script's `difference`.

    >>> import tactflow
    >>> scene = tactflow.open_scene("bright")
    >>> difference = tactflow.stage("classic_difference")
    >>> [difference.process(scene.frame(index)).touching for index in (0, 60)]
    [False, True]
    """

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._reference: NDArray[np.uint8] | None = None

    def process(self, unmarked: Unmarked, frame: Frame) -> ContactPorts:
        """Compare with the last reference, or with the first frame if none is marked as a reference."""
        if frame.reference or self._reference is None:
            self._reference = unmarked.copy()
        mask = difference(unmarked, self._reference)
        return ContactPorts(mask, bool(mask.any()))
