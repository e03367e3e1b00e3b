"""Stage `depth`: indentation of the gel as a height map, mm."""

from __future__ import annotations

import logging
from typing import Final

from pydantic import Field

from tactflow.calibration.file import Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask, Gradients, Unmarked, Untouched
from tactflow.vision.depth.darkness import DarkSurface
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Depth as HeightMap
from tactflow.vision.types import Scale

logger = logging.getLogger("tactflow")

CONTRADICTION_ERROR: Final = 0.5
"""Relative standard error of a depth above which its picture may be mirrored. Slopes of presses on five Minis
give at most 0.41, those of their mirror images 0.55 or more."""


class Depth(Stage):
    """Heights from the colour of the gel, or from its darkening, by the sensor's calibration, or from the
    gradients of a network.

    No depth exceeds the thickness of the gel, or half the width of the contact: what would is reported as
    this bound, and its standard error contains the difference. Absent without a calibration, or with one that
    knows the scale alone and no network; and, with the default of a kind of sensor, where the slopes
    contradict each other as those of a mirrored picture do.

    >>> import numpy as np
    >>> import tactflow
    >>> image, mask = np.zeros((60, 80, 3), np.uint8), np.full((60, 80), 255, np.uint8)
    >>> scale = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
    >>> tactflow.stage("depth").process(image, image, mask, scale)
    Absent(reason='no_calibration')
    """

    memory = "pure"

    class Params(StageParams):
        """What is known about the gel."""

        gel_thickness: float | None = Field(
            None, gt=0, description="of the gel, mm, which no depth exceeds; default: that of the calibration"
        )

    params: Params

    def __init__(self, params: Params, calibration: Calibration | None = None) -> None:
        """Prepare. calibration : of the sensor."""
        super().__init__(params)
        self._known = known = calibration
        self._thickness = params.gel_thickness
        if self._thickness is None and known is not None:
            self._thickness = known.gel_thickness
        photometric = None if known is None else known.photometric
        self._errors = None if photometric is None else photometric.errors()
        self._darkness = None if known is None or known.darkness is None else known.darkness.model()
        self._is_warned = False

    def process(
        self,
        unmarked: Unmarked,
        untouched: Untouched,
        contact_mask: ContactMask,
        scale: Scale,
        gradients: Gradients | None = None,
    ) -> HeightMap | Absent:
        """The height map of the contact."""
        known = self._known
        if known is None or (gradients is None and known.slopes is None and known.darkness is None):
            return Absent("no_calibration")
        if not contact_mask.any():
            return Absent("no_contact")
        rest = self.once(Rest, untouched)
        if known.darkness is not None and self._darkness is not None and gradients is None:
            dark = DarkSurface(self._darkness, scale, known.darkness.stderr, self._thickness)
            return dark.depth(unmarked, rest, contact_mask)
        if known.kind is None or gradients is not None:
            surface = Surface(known.slopes, scale, self._errors, self._thickness)
            return surface.depth(unmarked, rest, contact_mask, gradients)
        height, width = contact_mask.shape
        placed = self.once(known.at, scale, (width, height))
        surface = Surface(placed.slopes, scale, self._errors, self._thickness)
        slopes = surface.slopes(unmarked, rest, contact_mask)
        depth = surface.depth_of(slopes, contact_mask)
        if (depth.greatest_stderr or 0) <= CONTRADICTION_ERROR * depth.greatest:
            return depth
        if not surface.is_mirrored(slopes):
            return depth
        self._warn(known.kind)
        return Absent("mirrored")

    def _warn(self, kind: str) -> None:
        """Say once what to do with a mirrored picture."""
        if not self._is_warned:
            logger.warning(
                "depth: the slopes of a contact contradict each other, and not if left and right are "
                "exchanged: the picture is mirrored, and the calibration of a %s is not used for such "
                "frames. Take pictures as the sensor gives them, or calibrate these: `tactflow calibrate "
                "--area WIDTH HEIGHT --ball-radius MM`",
                kind,
            )
        self._is_warned = True
