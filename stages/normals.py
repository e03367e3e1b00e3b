"""Stage `normals`: unit normal of the gel's surface at each pixel."""

from __future__ import annotations

from tactflow.calibration.file import Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Absent
from tactflow.ports import ContactMask, Gradients, Normals, Unmarked, Untouched
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Scale


class SurfaceNormals(Stage):
    """Unit normals of the gel's surface, from its colour or from the gradients of a network, as in `depth`.

    Absent without a calibration of slopes and without a network.

    >>> import numpy as np
    >>> import tactflow
    >>> image, mask = np.zeros((60, 80, 3), np.uint8), np.full((60, 80), 255, np.uint8)
    >>> gradients = np.zeros((60, 80, 2), np.float32)
    >>> scale = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
    >>> normals = tactflow.stage("normals").process(image, image, mask, scale, gradients)
    >>> float(normals[30, 40, 2])
    1.0
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Calibration | None = None) -> None:
        """Prepare. calibration : of the sensor."""
        super().__init__(params)
        photometric = None if calibration is None else calibration.photometric
        self._slopes = None if calibration is None else calibration.slopes
        self._errors = None if photometric is None else photometric.errors()

    def process(
        self,
        unmarked: Unmarked,
        untouched: Untouched,
        contact_mask: ContactMask,
        scale: Scale,
        gradients: Gradients | None = None,
    ) -> Normals | Absent:
        """The normals of the contact and its surroundings; (0, 0, 1) elsewhere."""
        if self._slopes is None and gradients is None:
            return Absent("no_calibration")
        if not contact_mask.any():
            return Absent("no_contact")
        rest = self.once(Rest, untouched)
        return Surface(self._slopes, scale, self._errors).normals(unmarked, rest, contact_mask, gradients)
