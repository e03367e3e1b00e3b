"""Stage `slip`: whether what touches the gel slips."""

from __future__ import annotations

from typing import NamedTuple

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import ContactMask, Slipping, Touching
from tactflow.vision.flow import DisplacementField, SlipTest
from tactflow.vision.types import Slip


class SlipPorts(NamedTuple):
    """slipping : whether the contact slides over the gel. slip : that, and the part of it that sticks."""

    slipping: Slipping
    slip: Slip | None


class SlipStage(Stage):
    """Gross slip from the gel that a contact leaves behind, incipient slip from how the gel moves below it.

    `when: slipping` gates other stages. This stage needs no gate: without a contact it does next to nothing.
    """

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self._test = SlipTest()

    def reset(self) -> None:
        """A new reference follows: displacements are measured anew."""
        self._test.reset()

    def process(
        self, touching: Touching, contact_mask: ContactMask, field: DisplacementField | None = None
    ) -> SlipPorts:
        """Slip of this frame's contact; `slip` is absent without one, or where no marker is near."""
        if not touching or field is None:
            self._test.reset()
            return SlipPorts(False, None)
        slip = self._test(field, contact_mask)
        return SlipPorts(slip is not None and slip.slipping, slip)
