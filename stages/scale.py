"""Stage `scale`: millimetres per pixel, from the sensor's calibration."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import UNLIKE, Calibration
from tactflow.calibration.likeness import place
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Absent
from tactflow.ports import Untouched
from tactflow.system.spelling import distinct
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Markers
from tactflow.vision.types import Scale as MillimetresPerPixel

logger = logging.getLogger("tactflow")


class Scale(Stage):
    """Millimetres per pixel, from the file `calibration` of the pipeline; absent without it.

    A calibration made with frames of another size or another preprocess ends the run; a gel that looks
    different from the calibrated one is a warning. The default of a kind of sensor is compared with the
    pictures first: their light at rest, and the pitch of the dots, which gives the scale. It is not used,
    with a warning that says what to do, where they are turned, cropped, uncropped or of another sensor; nor
    is the calibration in a recording where it does not fit.

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
        self, untouched: Untouched, mapping: PixelMapping | None = None, markers: Markers | None = None
    ) -> MillimetresPerPixel | Absent:
        """The scale, or Absent("no_calibration")."""
        known = self._calibration
        if known is None:
            return Absent("no_calibration")
        if known.kind is None:
            scale = self.once(self._own, known, untouched, mapping)
        else:
            dots = None if markers is None or known.dot_pitch is None else markers.origin
            scale = self.once(self._of_kind, known, untouched, mapping, dots)
        return Absent("no_calibration") if scale is None else scale

    def _own(
        self, calibration: Calibration, untouched: Untouched, mapping: PixelMapping | None
    ) -> MillimetresPerPixel | None:
        """The scale for a new reference; None where a calibration that nobody chose does not fit."""
        first, self._is_described = not self._is_described, True
        size = untouched.shape[1], untouched.shape[0]
        misfit = calibration.misfit(mapping or PixelMapping.identity(size))
        if misfit is not None:
            if not calibration.recorded:
                raise StageError(f"{misfit}; use the pipeline that it was made with, or calibrate anew")
            if first:
                logger.warning("scale: the calibration in the recording is not used: %s", misfit)
            return None
        unlike = 100 * calibration.unlikeness(untouched)
        if unlike > 100 * UNLIKE:
            logger.warning(
                "scale: the untouched gel differs by %s %% of its brightness from the calibrated one "
                "(%s %% is usual at most): another sensor, another light, or something touches it",
                *distinct(unlike, 100 * UNLIKE),
            )
        return calibration.scale_at(size)

    def _of_kind(
        self,
        calibration: Calibration,
        untouched: Untouched,
        mapping: PixelMapping | None,
        dots: NDArray[np.float64] | None,
    ) -> MillimetresPerPixel | None:
        """The scale by the default of a kind for a new reference; None where it does not fit."""
        first, self._is_described = not self._is_described, True
        size = untouched.shape[1], untouched.shape[0]
        scale, words = place(calibration, untouched, mapping or PixelMapping.identity(size), dots)
        if first and scale is None:
            logger.warning("scale: the calibration of a %s is not used: %s", calibration.kind, words)
        elif first and scale is not None:
            _describe_default(calibration, scale, words)
        return scale


def _describe_default(calibration: Calibration, scale: MillimetresPerPixel, words: str) -> None:
    """Report the default with the errors that it has on other sensors of the kind."""
    photometric, depth = calibration.photometric, ""
    ball = "`tactflow calibrate --refine` with one press of a ball or more"
    if photometric is None:
        advice = f"for depth, {ball}"
    else:
        depth = f"depth +- {100 * photometric.depth_stderr:.0f} %, "
        advice = f"{ball} makes it that of this sensor"
    logger.info(
        "default calibration of a %s: %slengths +- %.0f %%%s; %s",
        calibration.kind,
        depth,
        100 * scale.stderr[0] / scale.x,
        f" ({words})" if words else "",
        advice,
    )
