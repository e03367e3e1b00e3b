"""Stage `classic_flow`: the original script's mean flow inside the contact."""

from __future__ import annotations

from pydantic import Field

from tactflow.classic.functions import mean_flow
from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask
from tactflow.vision.types import Flow, Markers


class ClassicFlow(Stage):
    """Mean displacement of the dots inside the contact, in whole pixels, as in the original script.

    Use it as the baseline. Lost dots count, too.

        flow_in_mask: {use: classic_flow, dilate: 8, when: touching}

    The numbers of the script's `draw_flow_mask`.

    >>> import numpy as np
    >>> import tactflow
    >>> origin = np.array([[10.0, 20.0], [30.0, 20.0]])
    >>> markers = Markers(origin, origin + [1.0, 0.5], np.zeros(2, np.uint8), np.full(2, 0.02))
    >>> tactflow.stage("classic_flow").process(markers, np.full((40, 40), 255, np.uint8)).count
    2
    """

    memory = "pure"

    class Params(StageParams):
        """Margin around the contact."""

        dilate: int = Field(8, ge=0, le=1000, description="pixels by which a square dilates the contact")

    def process(self, markers: Markers, contact_mask: ContactMask) -> Flow:
        """The flow inside the contact; its mean is None where no marker is inside."""
        return mean_flow(markers, contact_mask, self.params.dilate)
