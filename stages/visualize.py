"""Stage `visualize`: the processed frame with the results drawn on it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask, Image, Picture, Valid
from tactflow.vision.draw import Annotator
from tactflow.vision.flow import DisplacementField
from tactflow.vision.types import Contact, Flow, Markers


class Visualize(Stage):
    """Draw contact, markers and flow."""

    memory = "pure"

    class Params(StageParams):
        """What is drawn."""

        arrow_scale: float = Field(
            3.0, ge=0, le=1000, description="arrow length over displacement, 1; 1 ends it where the marker is"
        )
        view: Literal["frame", "contact"] = Field(
            "frame", description="contact: only the contact and the arrows inside it, the rest black"
        )
        ellipse: bool = Field(False, description="whether the fitted ellipse is drawn")
        field: bool = Field(False, description="whether the displacement between the markers is drawn")
        text: bool = Field(True, description="whether numbers are written")
        dilate: float = Field(
            8.0, ge=0, le=1000, description="view contact: how far outside the contact is shown, px"
        )

    def __init__(self, params: Params) -> None:
        self._field = params.field
        self._annotator = Annotator(
            arrow_scale=params.arrow_scale,
            view=params.view,
            ellipse=params.ellipse,
            text=params.text,
            dilate=params.dilate,
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
    ) -> Picture:
        """A new picture; what is absent is not drawn."""
        return self._annotator(
            image,
            contact=contact,
            flow=flow,
            markers=markers,
            contact_mask=contact_mask,
            valid=valid,
            field=field if self._field else None,
        )
