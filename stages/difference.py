"""Stage `difference`: where something touches the gel, against the reference."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field

from tactflow.engine.frame import Frame
from tactflow.engine.stage import StageParams
from tactflow.ports import ContactMask, Touching, Unmarked
from tactflow.vision.contact import ContactDetector


class ContactPorts(NamedTuple):
    """contact_mask : 255 in contact. touching : whether anything is."""

    contact_mask: ContactMask
    touching: Touching


class Difference:
    """Compare the unmarked frame with the untouched gel (seed function `difference`)."""

    memory = "stateful"

    class Params(StageParams):
        """method : how contact is told from no contact."""

        method: Literal["noise", "colour", "seed"] = Field(
            "noise", description="noise tests against the sensor's noise; seed is the original rule"
        )
        distance: float = Field(
            24.0, gt=0, le=441, description="`colour`: change of colour that is contact, grey levels"
        )

    def __init__(self, params: Params) -> None:
        self._detector = ContactDetector(params.method, distance=params.distance)

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._detector.reset()

    def process(self, unmarked: Unmarked, frame: Frame) -> ContactPorts:
        """The contact mask of this frame; the first frame serves as reference where none came before."""
        if frame.reference or not self._detector.has_reference:
            self._detector.add_reference(unmarked)
        result = self._detector.detect(unmarked)
        return ContactPorts(result.mask, result.touching)
