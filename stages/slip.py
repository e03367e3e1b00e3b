"""Stage `slip`: motion of the object relative to the gel."""

from __future__ import annotations

from typing import NamedTuple

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import ContactMask, MarkerMask, Slipping, Touching, Unmarked, Untouched
from tactflow.vision.flow import DisplacementField, SlipTracker
from tactflow.vision.flow.registration import cells, light_change
from tactflow.vision.types import Slip


class SlipPorts(NamedTuple):
    """slipping : whether the contact slides over the gel. slip : that, how far, and the part that sticks."""

    slipping: Slipping
    slip: Slip | None


class SlipStage(Stage):
    """Motion of the object relative to the gel: its picture on the gel against the markers.

    `when: slipping` gates other stages. This stage needs no gate: it returns at once without a contact.

    >>> import numpy as np
    >>> import tactflow
    >>> image, mask = np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), np.uint8)
    >>> tactflow.stage("slip").process(False, mask, image, image)
    SlipPorts(slipping=False, slip=None)
    """

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self._tracker = SlipTracker()

    def reset(self) -> None:
        """A new reference follows: displacements are measured anew."""
        self._tracker.reset()

    def process(
        self,
        frame: Frame,
        touching: Touching,
        contact_mask: ContactMask,
        unmarked: Unmarked,
        untouched: Untouched,
        marker_mask: MarkerMask | None = None,
        field: DisplacementField | None = None,
    ) -> SlipPorts:
        """Slip of this frame's contact; `slip` is absent without one, or where no marker is near."""
        if not touching or field is None:
            self._tracker.reset()
            return SlipPorts(False, None)
        change = light_change(unmarked, self.once(cells, untouched), marker_mask)
        slip = self._tracker(frame.seq, frame.t, change, field, contact_mask)
        return SlipPorts(slip is not None and slip.slipping, slip)
