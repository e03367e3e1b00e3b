"""Stage `difference`: where something touches the gel, against the reference."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactMask, Deviations, Touching, Unmarked, Valid
from tactflow.vision.contact import ContactDetector
from tactflow.vision.contact.reference import ReferenceCheck


class ContactPorts(NamedTuple):
    """contact_mask : 255 in contact. touching : whether anything is. deviations : what the mask comes from;
    None where nothing touches, and for `colour`."""

    contact_mask: ContactMask
    touching: Touching
    deviations: Deviations | None = None


class Difference(Stage):
    """Compare the unmarked frame with the untouched gel.

    It learns from all frames marked as reference (`colour`: from the last one), or else from the first frame.
    Where the gel is smoother than in the reference, it was the reference that was touched: that is no
    contact, and while it lasts, a new reference is asked for.
    """

    memory = "stateful"

    class Params(StageParams):
        """How contact is detected; the description of a parameter names the methods that use it."""

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
        patience: int = Field(
            30,
            ge=0,
            description="frames in a row in which the reference turns out to have been touched, after which "
            "a new one is taken; 0: none",
        )
        distance: float = Field(24.0, gt=0, le=441, description="colour: change that is contact, grey levels")

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._check: ReferenceCheck | None = None
        self._doubted = 0
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
        self._check, self._doubted = None, 0

    def process(
        self,
        unmarked: Unmarked,
        frame: Frame,
        valid: Valid | None = None,
    ) -> ContactPorts:
        """The contact mask of this frame; nothing outside of `valid` counts."""
        if frame.reference or not self._detector.has_reference:
            self._detector.add_reference(unmarked, valid)
            self._check = self._check or ReferenceCheck(unmarked)
        result = self._detector.detect(unmarked)
        if not result.touching or self._check is None or not self._check.was_touched(unmarked, result.mask):
            self._doubted = 0
            return ContactPorts(result.mask, result.touching, result.deviations)
        self._doubted += 1
        if self._doubted == self.params.patience > 0:
            self.wants_reference = "reference_touched"
        return ContactPorts(np.zeros_like(result.mask), False)
