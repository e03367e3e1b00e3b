"""Stage `scale`: millimetres per pixel, from the sensor's calibration."""

from __future__ import annotations

import logging

from tactflow.calibration.file import UNLIKE, UNLIKE_KIND, Calibration
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Absent
from tactflow.ports import Untouched
from tactflow.system.spelling import distinct
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale as MillimetresPerPixel

logger = logging.getLogger("tactflow")


class Scale(Stage):
    """Millimetres per pixel, from the file `calibration` of the pipeline; absent without it.

    A calibration made with frames of another size or another preprocess ends the run; a gel that looks
    different from the calibrated one is a warning. The default of a kind of sensor, or the calibration in a
    recording, is not used, with a warning, where it does not fit.

    >>> import numpy as np
    >>> import tactflow
    >>> tactflow.stage("scale").process(np.zeros((60, 80, 3), np.uint8))
    Absent(reason='no_calibration')
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Calibration | None = None) -> None:
        """Prepare. calibration : of the sensor."""
        super().__init__(params)
        self._calibration = calibration
        self._is_described = False

    def process(
        self, untouched: Untouched, mapping: PixelMapping | None = None
    ) -> MillimetresPerPixel | Absent:
        """The scale, or Absent("no_calibration")."""
        if self._calibration is None:
            return Absent("no_calibration")
        scale = self.once(self._fitting, self._calibration, untouched, mapping)
        return Absent("no_calibration") if scale is None else scale

    def _fitting(
        self, calibration: Calibration, untouched: Untouched, mapping: PixelMapping | None
    ) -> MillimetresPerPixel | None:
        """The scale for a new reference; None where a calibration that nobody chose does not fit."""
        kind, first, self._is_described = calibration.kind, not self._is_described, True
        size = untouched.shape[1], untouched.shape[0]
        unlike = 100 * calibration.unlikeness(untouched)
        misfit = calibration.misfit(mapping or PixelMapping.identity(size))
        if misfit is None and kind is not None and unlike > 100 * UNLIKE_KIND:
            measured, limit = distinct(unlike, 100 * UNLIKE_KIND)
            misfit = (
                f"the untouched gel differs from one by {measured} % of its brightness "
                f"({limit} % at most): another sensor, a turned picture, or "
                "something touches it"
            )
        if misfit is not None:
            if not (calibration.recorded or kind):
                raise StageError(f"{misfit}; use the pipeline that it was made with, or calibrate anew")
            if first:
                which = "in the recording" if kind is None else f"of a {kind}"
                logger.warning("scale: the calibration %s is not used: %s", which, misfit)
            return None
        if kind is None and unlike > 100 * UNLIKE:
            logger.warning(
                "scale: the untouched gel differs by %s %% of its brightness from the calibrated one "
                "(%s %% is usual at most): another sensor, another light, or something touches it",
                *distinct(unlike, 100 * UNLIKE),
            )
        elif kind is not None and first:
            _describe_default(calibration)
        return calibration.scale_at(size)


def _describe_default(calibration: Calibration) -> None:
    photometric, scale = calibration.photometric, calibration.scale
    depth = "" if photometric is None else f"depth +- {100 * photometric.depth_stderr:.0f} %, "
    logger.info(
        "default calibration of a %s: %slengths +- %.0f %%; `tactflow calibrate --refine` with one press of "
        "a ball or more makes it that of this sensor",
        calibration.kind,
        depth,
        100 * scale.stderr[0] / scale.x,
    )
