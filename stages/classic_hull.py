"""Stage `classic_hull`: the original script's geometry of the contact."""

from __future__ import annotations

from tactflow.classic.functions import get_convex_hull_area
from tactflow.engine.contract import Stage
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask
from tactflow.vision.types import Contact


class ClassicHull(Stage):
    """Hull, line through its vertices and ellipse of the contact, as in the original script.

    Use it as the baseline. Its centre is the middle of the line across the picture, not of the contact.

        hull: {use: classic_hull, when: touching}

    The script's `get_all_contour`, `get_convex_hull_area` and `regress_line`.

    >>> import numpy as np
    >>> import tactflow
    >>> mask = np.zeros((60, 80), np.uint8)
    >>> mask[20:30, 10:50] = 255
    >>> tactflow.stage("classic_hull").process(mask).area
    351.0
    """

    memory = "pure"

    def process(self, contact_mask: ContactMask) -> Contact | Absent:
        """Geometry of the contact, or Absent("no_contact") for an empty mask."""
        contact = get_convex_hull_area(contact_mask)
        return Absent("no_contact") if contact is None else contact
