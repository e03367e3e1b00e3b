"""Stage `fusion`: contact from the light and the motion of the markers."""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask, Deviations, Touching
from tactflow.vision.contact.fusion import fuse_contact
from tactflow.vision.flow.motion import MotionTest
from tactflow.vision.types import Evidence, Markers


class FusedPorts(NamedTuple):
    """Where something touches the gel.

    Attributes
    ----------
    contact_mask : 255 in contact.
    touching : whether anything is.
    evidence : what showed it.
    """

    contact_mask: ContactMask
    touching: Touching
    evidence: Evidence | None


class Fusion(Stage):
    """Combine the image's contact mask with the motion of the markers.

    A change of light over markers that all rest is rejected as a reflection. If it lasts, the stage requests
    a new reference.

    >>> import numpy as np
    >>> import tactflow
    >>> mask = np.full((60, 80), 255, np.uint8)
    >>> tactflow.stage("fusion").process(mask, True).evidence
    'light'
    """

    memory = "stateful"

    class Params(StageParams):
        """Sensitivity of the test for motion."""

        false_alarms: float = Field(
            1e-6,
            gt=0,
            lt=1,
            description="false contacts by the markers on the untouched gel, per frame, in addition to those "
            "of difference",
        )
        steadiness: float = Field(
            0.14,
            gt=0,
            le=100,
            description="jitter of markers on the untouched gel, standard deviation of x and of y, px",
        )
        relaxation: float = Field(
            0.1,
            ge=0,
            lt=1,
            description="motion that the markers of a released gel still show, relative to the strongest",
        )
        patience: int = Field(
            30,
            ge=0,
            description="consecutive frames with a change of light but no motion, after which a new "
            "reference is taken; 0: never",
        )

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference; a new one follows."""
        self._motion: MotionTest | None = None
        self._changed = 0

    def process(
        self,
        contact_mask: ContactMask,
        touching: Touching,
        markers: Markers | None = None,
        deviations: Deviations | None = None,
    ) -> FusedPorts:
        """What touches the gel, by both."""
        if markers is None:
            return FusedPorts(contact_mask, touching, "light" if touching else None)
        if self._motion is None or len(markers.origin) != self._motion.count:
            params = self.params
            self._motion = MotionTest(
                markers.origin,
                false_alarms=params.false_alarms,
                steadiness=params.steadiness,
                relaxation=params.relaxation,
            )
        fused = fuse_contact(contact_mask, markers, self._motion, deviations)
        self._changed = self._changed + 1 if fused.light_changed else 0
        if self._changed == self.params.patience > 0:
            self.wants_reference = "light_changed"
        return FusedPorts(fused.mask, fused.touching, fused.evidence)
