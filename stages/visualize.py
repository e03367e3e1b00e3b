"""Stage `visualize`: the processed frame with the results drawn on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from tactflow.drawing.results import Annotator
from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask, Image, Normals, Picture, Valid
from tactflow.vision.flow import DisplacementField
from tactflow.vision.types import Contact, Depth, Flow, Markers, Scale

_VIEW_INPUTS = {"depth": ("depth", "scale"), "normals": ("normals",)}
"""Inputs that only one view shows, by view."""


class Visualize(Stage):
    """Draw contact, markers and flow.

    >>> import numpy as np
    >>> import tactflow
    >>> image = np.full((60, 80, 3), 128, np.uint8)
    >>> tactflow.stage("visualize").process(image, None, None, None, None).shape
    (60, 80, 3)
    """

    memory = "pure"
    on_demand = True

    class Params(StageParams):
        """Contents of the picture."""

        arrow_scale: float = Field(
            3.0, ge=0, le=1000, description="arrow length over displacement, 1; 1 ends it where the marker is"
        )
        view: Literal["frame", "contact", "depth", "normals"] = Field(
            "frame",
            description="contact: only the contact and the arrows inside it, the rest black. depth: the "
            "height map instead of the picture; normals: those of the stage normals; need a calibration",
        )
        deepest: float = Field(1.0, gt=0, le=100, description="view depth: height of the lightest colour, mm")
        field: bool = Field(False, description="whether the displacement between the markers is drawn")
        text: bool = Field(True, description="whether numbers are written")

        def needed_inputs(self) -> Mapping[str, str]:
            """Views of the surface show heights or normals."""
            return dict.fromkeys(_VIEW_INPUTS.get(self.view, ()), "view")

        def unused_inputs(self) -> set[str]:
            """Inputs that are not shown need not be computed."""
            shown = {*_VIEW_INPUTS.get(self.view, ()), *(["field"] if self.field else [])}
            return {"depth", "scale", "normals", "field"} - shown

    def __init__(self, params: Params) -> None:
        self._annotator = Annotator(
            arrow_scale=params.arrow_scale,
            view=params.view,
            text=params.text,
            deepest=params.deepest,
        )

    def process(
        self,
        image: Image,
        contact: Contact | None,
        flow: Flow | None,
        markers: Markers | None,
        contact_mask: ContactMask | None,
        valid: Valid | None = None,
        field: DisplacementField | None = None,
        depth: Depth | None = None,
        scale: Scale | None = None,
        normals: Normals | None = None,
    ) -> Picture:
        """A new picture; missing inputs are not drawn."""
        return self._annotator(
            image,
            contact=contact,
            flow=flow,
            markers=markers,
            contact_mask=contact_mask,
            valid=valid,
            field=field,
            depth=depth,
            scale=scale,
            normals=normals,
        )
