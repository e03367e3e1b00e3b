"""Stage `hull`: geometry of the contact region."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask
from tactflow.vision import compiled
from tactflow.vision.geometry import moments
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.types import Contact, Evidence


class Hull(Stage):
    """Hull, area, centroid, direction and ellipse of the contact."""

    memory = "pure"

    class Params(StageParams):
        """Which components of the mask are the contact, and how it is described."""

        min_area: float = Field(
            20.0, ge=0, description="smaller components are ignored, px^2; too large misses light contacts"
        )
        max_gap: float | None = Field(
            None,
            ge=0,
            description="components farther apart than this are not one contact, px; null: all are",
        )
        min_confidence: float = Field(
            0.3,
            ge=0,
            le=1,
            description="regions less elongated than this get no direction, 1: 0.3 is an axis ratio of 1.36, "
            "which 5 % of 200 real presses of a ball exceed, since light makes a mask lopsided",
        )

    def __init__(self, params: Params) -> None:
        self._params = params
        compiled.load(moments)

    def process(self, contact_mask: ContactMask, evidence: Evidence | None = None) -> Contact | Absent:
        """Geometry of the contact, or Absent("no_contact") where the mask holds none."""
        params = self._params
        contact = contact_geometry(
            contact_mask,
            min_area=params.min_area,
            max_gap=params.max_gap,
            min_confidence=params.min_confidence,
        )
        if contact is None:
            return Absent("no_contact")
        return contact if evidence is None else replace(contact, evidence=evidence)
