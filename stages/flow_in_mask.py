"""Stage `flow_in_mask`: motion of the gel inside the contact."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask
from tactflow.vision.flow import DisplacementField, flow_in_mask, flow_of_field
from tactflow.vision.types import Evidence, Flow, Markers


class FlowInMask(Stage):
    """Mean displacement, rotation and divergence of the gel inside the contact.

    >>> import numpy as np
    >>> import tactflow
    >>> origin = np.array([[10.0, 20.0], [30.0, 20.0]])
    >>> markers = Markers(origin, origin + [1.0, 0.5], np.zeros(2, np.uint8), np.full(2, 0.02))
    >>> tactflow.stage("flow_in_mask").process(markers, np.full((40, 40), 255, np.uint8)).mean
    (1.0, 0.5)
    """

    memory = "pure"

    class Params(StageParams):
        """How the flow is measured."""

        method: Literal["field", "mean", "median"] = Field(
            "field",
            description="field: the integral of the displacement field over the contact, where a stage field "
            "stands above; mean, and where none does: the mean over the markers inside; median: of each "
            "component, which a few wrong markers do not move",
        )

    params: Params

    def process(
        self,
        markers: Markers,
        contact_mask: ContactMask,
        field: DisplacementField | None = None,
        evidence: Evidence | None = None,
    ) -> Flow:
        """The flow inside the contact; its mean is None where no marker is inside, or none near."""
        if field is None or self.params.method != "field":
            average: Literal["mean", "median"] = "median" if self.params.method == "median" else "mean"
            return flow_in_mask(markers, contact_mask, average=average)
        return flow_of_field(field, markers, contact_mask, coarse=evidence == "dots")
