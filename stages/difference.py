"""Stage `difference`: detect contact by comparison with the reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.engine.frame import Frame
from tactflow.parameters import GelParams
from tactflow.ports import ContactMask, CoreMask, Deviations, Touching, Unmarked, Valid
from tactflow.vision.contact import ContactDetector
from tactflow.vision.contact.reference import ReferenceCheck


class ContactPorts(NamedTuple):
    """Where something touches the gel.

    Attributes
    ----------
    contact_mask : 255 in contact.
    touching : whether anything is.
    deviations : the changes behind the mask; None without contact.
    core_mask : 255 where the gel clings to the object; None without contact.
    """

    contact_mask: ContactMask
    touching: Touching
    deviations: Deviations | None = None
    core_mask: CoreMask | None = None


class Difference(Stage):
    """Compare the unmarked frame with the untouched gel.

    It learns from all frames marked as reference, or else from the first frame. If the gel is smoother than
    in the reference, the reference was touched: nothing is reported as contact, and after `patience` frames
    the stage requests a new reference.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> difference = tactflow.stage("difference")
    >>> [difference.process(scene.frame(index)).touching for index in (0, 60)]
    [False, True]
    """

    memory = "stateful"

    class Params(GelParams):
        """Sensitivity of the test against the sensor's own noise."""

        false_alarms: float = Field(
            1e-6, gt=0, lt=1, description="false contacts on the untouched gel, per frame"
        )
        shift: float = Field(
            1.0, ge=0, le=100, description="movement of the untouched gel against the camera, px"
        )
        relaxation: float = Field(
            0.2, ge=0, lt=1, description="change that a released gel still shows, relative to the strongest"
        )
        creep: float = Field(
            0.1, ge=0, le=1, description="largest fraction of its change that a released gel loses per frame"
        )
        border: float = Field(
            0.55,
            gt=0,
            lt=1,
            description="slope of the gel at the outline, as a fraction of the steepest nearby: 0.55 is the "
            "outer edge of the imprint; higher draws it farther in",
        )
        core: float = Field(
            0.8,
            gt=0,
            lt=1,
            description="the same for the core of a contact, where the gel clings to the object: "
            "`tactflow calibrate` says which value is right for your sensor; at least `border`",
        )
        patience: int = Field(
            30,
            ge=0,
            description="consecutive frames that show the reference to have been touched, after which a new "
            "one is taken; 0: never",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._check: ReferenceCheck | None = None
        self._doubted = 0
        self._detector = ContactDetector(
            false_alarms=params.false_alarms,
            repeatability=params.repeatability,
            tint=params.tint,
            shift=params.shift,
            relaxation=params.relaxation,
            creep=params.creep,
            border=params.border,
            core=params.core,
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
            return ContactPorts(result.mask, result.touching, result.deviations, result.core)
        self._doubted += 1
        if self._doubted == self.params.patience > 0:
            self.wants_reference = "reference_touched"
        return ContactPorts(np.zeros_like(result.mask), False)
