"""Stage `hull`: geometry of the contact region."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask, CoreMask, Deviations
from tactflow.vision.contact.certainty import with_probability, without_doubtful
from tactflow.vision.geometry.hull import contact_geometry, contact_parts
from tactflow.vision.types import Contact, Evidence


class Hull(Stage):
    """Hull, area, centroid, direction and ellipse of the contact, and of each separate one.

    >>> import numpy as np
    >>> import tactflow
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> tactflow.stage("hull").process(mask).area
    400.0
    """

    memory = "pure"

    class Params(StageParams):
        """Which components of the mask are the contact, and how it is described."""

        min_area: float = Field(
            20.0, ge=0, description="smaller components are ignored, px^2; too large misses light contacts"
        )
        merge: Literal["all", "largest"] = Field(
            "all",
            description="all: all regions are one contact, except improbable ones next to a more probable "
            "one; largest: the region with the most pixels. The separate regions are reported as well",
        )
        min_confidence: float = Field(
            0.3,
            ge=0,
            le=1,
            description="regions less elongated than this get no direction, 1: 0.3 is an axis ratio of 1.36, "
            "which 5 % of 200 real presses of a ball exceed, since light makes a mask lopsided",
        )

    params: Params

    def process(
        self,
        contact_mask: ContactMask,
        evidence: Evidence | None = None,
        deviations: Deviations | None = None,
        core_mask: CoreMask | None = None,
    ) -> Contact | Absent:
        """Geometry of the contact, or Absent("no_contact") where the mask holds none."""
        params = self.params
        # The dots show no edge of the imprint, and so no core.
        core = None if evidence == "dots" else core_mask
        parts = contact_parts(
            contact_mask,
            min_area=params.min_area,
            min_confidence=params.min_confidence,
            evidence=evidence or "light",
            core=core,
        )
        if not parts:
            return Absent("no_contact")
        if deviations is not None:
            parts = with_probability(parts, contact_mask, deviations)
        contact = parts[0]
        if len(parts) == 1:
            return contact
        if params.merge == "all":
            probable, mask = without_doubtful(parts, contact_mask)
            contact = probable[0]
            whole = contact_geometry(
                mask, min_area=params.min_area, min_confidence=params.min_confidence, core=core
            )
            if whole is not None:
                contact = replace(whole, evidence=contact.evidence, probability=contact.probability)
        return replace(contact, separate=tuple(parts))
