"""Stage `slip`: motion of the object relative to the gel."""

from __future__ import annotations

from typing import NamedTuple

from tactflow.engine.contract import Stage
from tactflow.engine.frame import Frame
from tactflow.parameters import LightParams
from tactflow.ports import ContactMask, MarkerMask, Slipping, Touching, Unmarked, Untouched
from tactflow.vision.arrays import ColorImage
from tactflow.vision.flow import DisplacementField, SlipTracker
from tactflow.vision.flow.registration import cells, light_change
from tactflow.vision.types import Slip


class SlipPorts(NamedTuple):
    """slipping : whether slip is reported. slip : that, how far the object has slid, and the part that
    sticks."""

    slipping: Slipping
    slip: Slip | None


class SlipStage(Stage):
    """Motion of the object relative to the gel: its picture on the gel against the markers.

    A slip is reported once two of three frames clearly show it, so that a gripper may act on `slipping`,
    which also gates other stages (`when: slipping`). This stage needs no gate: it returns at once without a
    contact.

    >>> import numpy as np
    >>> import tactflow
    >>> image, mask = np.zeros((60, 80, 3), np.uint8), np.zeros((60, 80), np.uint8)
    >>> tactflow.stage("slip").process(False, mask, image, image)
    SlipPorts(slipping=False, slip=None)
    """

    memory = "stateful"

    class Params(LightParams):
        """How steady the light is."""

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self._repeatability = params.repeatability
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
        unsteadiness = self._repeatability * self.once(_brightness, untouched)
        slip = self._tracker(frame.seq, frame.t, change, field, contact_mask, unsteadiness)
        return SlipPorts(slip is not None and slip.slipping, slip)


def _brightness(untouched: ColorImage) -> float:
    """Mean light of the untouched gel, grey levels."""
    return float(untouched.mean())
