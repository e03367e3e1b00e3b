"""Whether a calibration still fits its sensor."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from tactflow.calibration.darkness import darkness_error
from tactflow.calibration.file import UNLIKE, Calibration, DarknessEntry, ForceEntry, PhotometricEntry
from tactflow.calibration.force import try_force
from tactflow.calibration.force_samples import Watched
from tactflow.calibration.presses import Session
from tactflow.calibration.reference import Reference
from tactflow.calibration.samples import press_errors, summary
from tactflow.calibration.words import darkness_words, photometric_words
from tactflow.vision.field_force import FieldForce

MIN_DRIFT_RATIO: Final = 1.5
"""Ratio of the error on new presses to the stored one above which a calibration counts as drifted."""


class Comparison(NamedTuple):
    """A calibration against what a session shows.

    Attributes
    ----------
    fits : whether the gel and the depth are still as they were.
    lines : what was compared, in words.
    """

    fits: bool
    lines: list[str]


def check(calibration: Calibration, session: Session) -> Comparison:
    """Compare the untouched gel, and the depth, with what a session shows.

    session : with a mapping that the calibration fits (`Calibration.misfit`).
    """
    unlike = calibration.unlikeness(session.untouched)
    lines = [
        f"untouched gel: differs by {100 * unlike:.1f} % of its brightness; up to {100 * UNLIKE:.0f} % fits"
    ]
    if unlike > UNLIKE:
        lines.append("another sensor or light, or an object on the gel at the start, also make it differ")
    pressed = calibration.photometric or calibration.darkness
    depth = Comparison(True, []) if pressed is None else _check_depth(calibration, pressed, session)
    return Comparison(unlike <= UNLIKE and depth.fits, lines + depth.lines)


def _check_depth(
    calibration: Calibration, then: PhotometricEntry | DarknessEntry, session: Session
) -> Comparison:
    """Compare the depth with the presses of today; it fits where there are none."""
    radius, scale = f"{then.ball_radius:g} mm", calibration.scale
    if not session.presses:
        text = f"no presses today: to check the depth, press a ball of radius {radius} on the untouched gel"
        return Comparison(True, [text])
    if isinstance(then, DarknessEntry):
        error, limit, unit = darkness_error(session, then, scale), MIN_DRIFT_RATIO * then.stderr, "mm RMS"
        now_words = f"depth {error:.3f} mm RMS off" if math.isfinite(error) else "none can be used"
        words = now_words, darkness_words(then)
    else:
        assert calibration.slopes is not None
        now = summary(press_errors(session, calibration.slopes, scale, then.ball_radius))
        error, limit, unit = now["normal_error"], MIN_DRIFT_RATIO * then.normal_error, "degrees"
        words = photometric_words(now), photometric_words(then.model_dump())
    lines = [f"presses today, {len(session.presses)}: {words[0]}", f"when it was made: {words[1]}"]
    if error > limit:
        others = f"few presses, a ball whose radius is not {radius}, or no untouched gel at first"
        lines.append(f"up to {limit:.2g} {unit} fit; {others} also give larger errors")
    return Comparison(error <= limit, lines)


def check_force(
    then: ForceEntry, field: FieldForce | None, watched: Watched, readings: Reference
) -> Comparison:
    """Compare the force with the readings of a gauge. field : of the force by dots, None without."""
    now, usual = try_force(then, readings.name, watched, readings, field), then.pressing.rmse
    text = f"force: {now:.2f} N RMS from the gauge today; when it was made: {usual:.2f} N"
    return Comparison(now <= MIN_DRIFT_RATIO * usual, [text])
