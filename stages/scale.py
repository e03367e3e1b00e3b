"""Stage `scale`: millimetres per pixel, from the sensor's calibration."""

from __future__ import annotations

import logging
from pathlib import Path

from tactflow.calibration.file import UNLIKE, UNLIKE_KIND, Calibration
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
    different from the calibrated one is a warning. The default of a kind of sensor is not used,
    with a warning, where frames or gel are of another kind.
    """

    memory = "pure"

    def __init__(self, params: StageParams, calibration: Path | None = None) -> None:
        """Prepare. calibration : the file."""
        super().__init__(params)
        self._calibration = None if calibration is None else Calibration.load(calibration)
        self._recorded = calibration is not None and calibration.suffix == ".mcap"
        self._checked: Untouched | None = None
        self._scale: MillimetresPerPixel | None = None

    def process(
        self, untouched: Untouched, mapping: PixelMapping | None = None
    ) -> MillimetresPerPixel | Absent:
        """The scale, or Absent("no_calibration")."""
        calibration = self._calibration
        if calibration is not None and self._checked is not untouched:
            mapping = mapping or PixelMapping.identity((untouched.shape[1], untouched.shape[0]))
            first = self._checked is None
            self._scale = _fitting(calibration, untouched, mapping, first, self._recorded)
            self._checked = untouched
        return Absent("no_calibration") if self._scale is None else self._scale


def _fitting(
    calibration: Calibration, untouched: Untouched, mapping: PixelMapping, first: bool, recorded: bool
) -> MillimetresPerPixel | None:
    """The scale for frames with a new reference; None where a calibration that nobody chose does not fit.

    first : whether it is the first reference. recorded : whether the calibration came with the recording.
    """
    misfit = calibration.misfit(mapping)
    if misfit is None and calibration.kind is not None:
        misfit = _unlike_kind(untouched, calibration)
    if misfit is not None:
        if not (recorded or calibration.kind):
            raise StageError(f"{misfit}; use the pipeline that it was made with, or calibrate anew")
        if first:
            which = "in the recording" if calibration.kind is None else f"of a {calibration.kind}"
            logger.warning("scale: the calibration %s is not used: %s", which, misfit)
        return None
    if calibration.kind is None:
        _warn_if_unlike(untouched, calibration)
    elif first:
        _tell_default(calibration)
    return calibration.scale_at((untouched.shape[1], untouched.shape[0]))


def _tell_default(calibration: Calibration) -> None:
    photometric, scale = calibration.photometric, calibration.scale
    depth = "" if photometric is None else f"depth +- {100 * photometric.depth_stderr:.0f} %, "
    logger.info(
        "default calibration of a %s: %slengths +- %.0f %%; `tactflow calibrate --refine` with one press of "
        "a ball or more makes it that of this sensor",
        calibration.kind,
        depth,
        100 * scale.stderr[0] / scale.x,
    )


def _unlike_kind(untouched: Untouched, calibration: Calibration) -> str | None:
    """Why the gel cannot be of the kind that a default calibration is for; None if it can."""
    unlike = calibration.unlikeness(untouched)
    if unlike <= UNLIKE_KIND:
        return None
    return (
        f"the untouched gel differs from one by {100 * unlike:.0f} % of its brightness "
        f"({100 * UNLIKE_KIND:.0f} % at most): another sensor, a turned picture, or something touches it"
    )


def _warn_if_unlike(untouched: Untouched, calibration: Calibration) -> None:
    unlike = calibration.unlikeness(untouched)
    if unlike > UNLIKE:
        logger.warning(
            "scale: the untouched gel differs by %.0f %% of its brightness from the calibrated one "
            "(%.0f %% is usual at most): another sensor, another light, or something touches it",
            100 * unlike,
            100 * UNLIKE,
        )
