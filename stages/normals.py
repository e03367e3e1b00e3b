"""Stage `normals`: unit normal of the gel's surface at each pixel."""

from __future__ import annotations

from pathlib import Path

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

    def __init__(self, params: StageParams, calibration: Path | None = None) -> None:
        """Prepare. calibration : the file."""
        super().__init__(params)
        known = None if calibration is None else Calibration.load(calibration)
        photometric = None if known is None else known.photometric
        self._slopes = None if known is None else known.slopes
        self._errors = None if photometric is None else photometric.errors()
        self._rest: tuple[Untouched, Rest] | None = None

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
        if self._rest is None or self._rest[0] is not untouched:
            self._rest = untouched, Rest(untouched)
        return Surface(self._slopes, scale, self._errors).normals(
            unmarked, self._rest[1], contact_mask, gradients
        )
