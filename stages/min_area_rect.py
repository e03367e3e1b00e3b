"""Stage `min_area_rect`: geometry of the contact by the smallest rectangle around it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask
from tactflow.vision.geometry.hull import contact_of_outline, large_contours
from tactflow.vision.types import Contact


class MinAreaRect(Stage):
    """Hull and area of the contact, with the smallest rectangle around it for centre and direction.

    Use it for boxes, bars and edges that end inside the picture. A single pixel that sticks out turns it; a
    bent or round contact has no stable rectangle.

        hull: {use: min_area_rect, when: touching}

    G. Toussaint, "Solving geometric problems with the rotating calipers", IEEE MELECON 1983.

    >>> import tactflow
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> tactflow.stage("min_area_rect").process(mask).area
    400.0
    """

    memory = "pure"

    class Params(StageParams):
        """Which components and directions count."""

        min_area: float = Field(20.0, ge=0, description="smaller components are ignored, px^2")
        min_confidence: float = Field(
            0.3, ge=0, le=1, description="contacts less elongated than this get no direction, see hull"
        )

    def process(self, contact_mask: ContactMask) -> Contact | Absent:
        """Geometry of the contact, or Absent("no_contact") where the mask holds none."""
        contours = large_contours(contact_mask, self.params.min_area)
        if not contours:
            return Absent("no_contact")
        center, (width, height), degrees = cv2.minAreaRect(np.concatenate(contours))
        # The corners are centres of pixels: each side is a pixel longer.
        squares = (width + 1) ** 2, (height + 1) ** 2
        confidence = abs(squares[0] - squares[1]) / sum(squares)
        turned = math.radians(degrees if width >= height else degrees + 90)
        angle = turned if confidence > self.params.min_confidence else None
        place = float(center[0]), float(center[1])
        return contact_of_outline(contours, place, angle, confidence, float(cv2.countNonZero(contact_mask)))
