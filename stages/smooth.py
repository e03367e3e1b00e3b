"""Stage `smooth`: a steadier contact, at the price of some delay."""

from __future__ import annotations

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent, Frame
from tactflow.vision.smooth import ContactSmoother
from tactflow.vision.types import Contact


class Smooth(Stage):
    """Filter the contact's centre and angle over time; hull, area and ellipse stay as measured."""

    memory = "stateful"

    class Params(StageParams):
        """How strong the filter (One Euro) is."""

        min_cutoff: float = Field(
            1.0, gt=0, le=1000, description="cut-off at rest, Hz; lower is steadier and slower"
        )
        speed_coefficient: float = Field(
            0.02, ge=0, le=1000, description="Hz of cut-off per px/s or degree/s; higher lags less in motion"
        )

    def __init__(self, params: Params) -> None:
        self._smoother = ContactSmoother(params.min_cutoff, params.speed_coefficient)

    def reset(self) -> None:
        """Forget the past; a new reference follows."""
        self._smoother.reset()

    def process(self, contact: Contact | None, frame: Frame) -> Contact | Absent:
        """The smoothed contact; after a frame without contact, the filter starts afresh."""
        if contact is None:
            self._smoother.reset()
            return Absent("no_contact")
        return self._smoother.update(contact, frame.t)
