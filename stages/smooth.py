"""Stage `smooth`: a steadier contact, at the price of some delay."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent, Frame
from tactflow.vision.smooth import ContactSmoother
from tactflow.vision.types import Contact


class Smooth(Stage):
    """Filter the contact's centre and angle over time; hull, area and ellipse stay as measured."""

    memory = "stateful"

    class Params(StageParams):
        """Which filter, and how strong."""

        method: Literal["one_euro", "alpha_beta"] = Field(
            "one_euro", description="one_euro adapts to speed; alpha_beta predicts constant velocity"
        )
        min_cutoff: float = Field(
            1.0, gt=0, le=1000, description="one_euro: cut-off at rest, Hz; lower is steadier and slower"
        )
        speed_coefficient: float = Field(
            0.02, ge=0, le=1000, description="one_euro: Hz of cut-off per px/s or degree/s; higher lags less"
        )
        alpha: float = Field(
            0.5, gt=0, le=1, description="alpha_beta: fraction of the innovation that corrects the value, 1"
        )
        beta: float | None = Field(
            None,
            ge=0,
            lt=4,
            description="alpha_beta: fraction that corrects the velocity, 1; null fits alpha",
        )

        @model_validator(mode="after")
        def _usable(self) -> Self:
            _smoother(self)
            return self

    def __init__(self, params: Params) -> None:
        self._smoother = _smoother(params)

    def reset(self) -> None:
        """Forget the past; a new reference follows."""
        self._smoother.reset()

    def process(self, contact: Contact | None, frame: Frame) -> Contact | Absent:
        """The smoothed contact; after a frame without contact, the filter starts afresh."""
        if contact is None:
            self._smoother.reset()
            return Absent("no_contact")
        return self._smoother.update(contact, frame.t)


def _smoother(params: Smooth.Params) -> ContactSmoother:
    return ContactSmoother(
        params.method,
        min_cutoff=params.min_cutoff,
        speed_coefficient=params.speed_coefficient,
        alpha=params.alpha,
        beta=params.beta,
    )
