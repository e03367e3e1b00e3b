"""Stage `fit_line`: geometry of the contact, with its direction by a line through its outline."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask
from tactflow.vision.geometry.hull import contact_of_outline, large_contours
from tactflow.vision.types import Contact


class FitLine(Stage):
    """Hull and area of the contact, with a line fitted to its outline for centre and direction.

    Use `huber` for contacts whose outline has long spurs, such as a cable beside a glint; otherwise both are
    the same. The centre is that of the outline, which leans towards its ragged side.

        hull: {use: fit_line, distance: huber, when: touching}

    P. J. Huber, "Robust estimation of a location parameter", Annals of Mathematical Statistics 35 (1964).

    >>> import tactflow
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> tactflow.stage("fit_line").process(mask).area
    400.0
    """

    memory = "pure"

    class Params(StageParams):
        """The fit, and which components and directions count."""

        distance: Literal["l2", "huber"] = Field(
            "l2", description="l2: least squares; huber: absolute distances beyond 1.345 px"
        )
        min_area: float = Field(20.0, ge=0, description="smaller components are ignored, px^2")
        min_confidence: float = Field(
            0.3, ge=0, le=1, description="outlines less elongated than this get no direction, see hull"
        )

    def process(self, contact_mask: ContactMask) -> Contact | Absent:
        """Geometry of the contact, or Absent("no_contact") where the mask holds none."""
        contours = large_contours(contact_mask, self.params.min_area)
        if not contours:
            return Absent("no_contact")
        points = np.concatenate(contours)[:, 0].astype(np.float32)
        kind = cv2.DIST_HUBER if self.params.distance == "huber" else cv2.DIST_L2
        vx, vy, x, y = (float(value) for value in np.ravel(cv2.fitLine(points, kind, 0, 0.01, 0.01)))
        away = points - np.array([x, y], np.float32)
        along, across = float(np.var(away @ [vx, vy])), float(np.var(away @ [-vy, vx]))
        confidence = abs(along - across) / (along + across) if along + across > 0 else 0.0
        angle = math.atan2(vy, vx) if confidence > self.params.min_confidence else None
        return contact_of_outline(contours, (x, y), angle, confidence, float(cv2.countNonZero(contact_mask)))
