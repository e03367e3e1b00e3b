"""Stage `difference`: where something touches the gel, against the reference."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactMask, MarkerMask, Touching, Unmarked, Valid
from tactflow.vision.contact import ContactDetector


class ContactPorts(NamedTuple):
    """contact_mask : 255 in contact. touching : whether anything is."""

    contact_mask: ContactMask
    touching: Touching


class Difference(Stage):
    """Compare the unmarked frame with the untouched gel.

    It learns from all frames marked as reference (`colour`: from the last one), or else from the first frame.
    """

    memory = "stateful"

    class Params(StageParams):
        """How contact is detected; each parameter but `method` belongs to one method."""

        method: Literal["noise", "colour"] = Field(
            "noise",
            description="noise tests against the sensor's own noise, for gels that answer with brightness or "
            "colour; colour is a plain distance of colours",
        )
        false_alarms: float = Field(
            1e-6, gt=0, lt=1, description="noise: false contacts of the untouched gel, per frame"
        )
        repeatability: float = Field(
            0.025, ge=0, le=1, description="noise: how far the light of the gel itself varies, relative"
        )
        tint: float = Field(
            0.01,
            ge=0,
            le=1,
            description="noise: how far the colour of that light varies, relative to its brightness",
        )
        shift: float = Field(
            1.0, ge=0, le=100, description="noise: how far the untouched gel moves against the camera, px"
        )
        relaxation: float = Field(
            0.2,
            ge=0,
            lt=1,
            description="noise: what a released gel still shows, relative to the strongest change",
        )
        creep: float = Field(
            0.1,
            ge=0,
            le=1,
            description="noise: how much of its change a released gel loses from frame to frame at most",
        )
        distance: float = Field(24.0, gt=0, le=441, description="colour: change that is contact, grey levels")

    def __init__(self, params: Params) -> None:
        self._detector = ContactDetector(
            params.method,
            false_alarms=params.false_alarms,
            repeatability=params.repeatability,
            tint=params.tint,
            shift=params.shift,
            relaxation=params.relaxation,
            creep=params.creep,
            distance=params.distance,
        )

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._detector.reset()

    def process(
        self,
        unmarked: Unmarked,
        frame: Frame,
        marker_mask: MarkerMask | None = None,
        valid: Valid | None = None,
    ) -> ContactPorts:
        """The contact mask of this frame; below markers its outline runs straight.

        Nothing outside of `valid` counts.
        """
        if frame.reference or not self._detector.has_reference:
            self._detector.add_reference(unmarked, valid)
        result = self._detector.detect(unmarked, marker_mask)
        return ContactPorts(result.mask, result.touching)
