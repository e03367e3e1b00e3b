"""Stage `flow_in_mask`: how the markers inside the contact move."""

from __future__ import annotations

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask
from tactflow.vision import compiled
from tactflow.vision.contact import inside
from tactflow.vision.flow import flow_in_mask, similarity
from tactflow.vision.types import Flow, Markers


class FlowInMask(Stage):
    """Mean displacement, rotation and divergence of the markers inside the contact."""

    memory = "pure"

    class Params(StageParams):
        """Which markers count as inside."""

        dilate: float = Field(
            0.3,
            ge=0,
            le=1000,
            description="markers whose centre is up to this far outside the contact's outline count too, px; "
            "more markers make the mean steadier and mix in gel that moves less",
        )

    def __init__(self, params: Params) -> None:
        self._params = params
        compiled.load(similarity, inside)

    def process(self, markers: Markers, contact_mask: ContactMask) -> Flow:
        """The flow inside the contact; its mean is None where no marker is inside."""
        return flow_in_mask(markers, contact_mask, dilate=self._params.dilate)
