"""Stage `scale`: millimetres per pixel, from the sensor's calibration."""

from __future__ import annotations

import logging
from pathlib import Path

from tactflow.calibration.file import UNLIKE, Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Absent
from tactflow.ports import Untouched
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale as MillimetresPerPixel

logger = logging.getLogger("tactflow")


class Scale(Stage):
    """Millimetres per pixel, as `calibration` of the pipeline file says; nothing without it.

    A calibration made with frames of another size or another preprocess ends the run; a gel that looks
    different from the calibrated one is a warning.
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Path | None = None) -> None:
        """Prepare. calibration : the file."""
        super().__init__(params)
        self._calibration = None if calibration is None else Calibration.load(calibration)
        self._recorded = calibration is not None and calibration.suffix == ".mcap"
        self._checked: Untouched | None = None

    def process(
        self, untouched: Untouched, mapping: PixelMapping | None = None
    ) -> MillimetresPerPixel | Absent:
        """The scale, or Absent("no_calibration")."""
        calibration = self._calibration
        if calibration is None:
            return Absent("no_calibration")
        size = (untouched.shape[1], untouched.shape[0])
        misfit = calibration.misfit(mapping or PixelMapping.identity(size))
        if misfit is not None and self._recorded:
            # It came with the recording; nobody asked for it.
            if self._checked is None:
                logger.warning("scale: the calibration in the recording is not used: %s", misfit)
            self._checked = untouched
            return Absent("no_calibration")
        if misfit is not None:
            raise StageError(f"{misfit}; use the pipeline that it was made with, or calibrate anew")
        if self._checked is not untouched:
            self._checked = untouched
            _warn_if_unlike(untouched, calibration)
        return calibration.scale


def _warn_if_unlike(untouched: Untouched, calibration: Calibration) -> None:
    unlike = calibration.unlikeness(untouched)
    if unlike > UNLIKE:
        logger.warning(
            "scale: the untouched gel differs by %.0f %% of its brightness from the calibrated one "
            "(%.0f %% is usual at most): another sensor, another light, or something touches it",
            100 * unlike,
            100 * UNLIKE,
        )
