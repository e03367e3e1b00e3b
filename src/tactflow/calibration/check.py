"""Whether a calibration still fits its sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from tactflow.calibration.darkness import darkness_error
from tactflow.calibration.file import UNLIKE, Calibration, DarknessEntry, PhotometricEntry
from tactflow.calibration.force import Watched, try_force
from tactflow.calibration.presses import Session
from tactflow.calibration.reference import Reference
from tactflow.calibration.samples import press_errors, summary
from tactflow.calibration.words import darkness_words, photometric_words

DRIFTED: Final = 1.5
"""Ratio of the error on new presses to the stored one above which a calibration counts as drifted."""


Show = Callable[[str], None]
"""Shows a line."""


def check(
    calibration: Calibration,
    session: Session,
    show: Show,
    force_today: Callable[[], tuple[Watched, Reference]] | None = None,
) -> bool:
    """Compare a calibration with what a session shows; returns whether it still fits.

    show : shows what was compared. force_today : features of a recording, and the readings of its gauge;
    called after all else was compared. None without a gauge.
    """
    if (misfit := calibration.misfit(session.mapping)) is not None:
        show(f"does not fit: {misfit}; use the pipeline that it was made with, or calibrate again")
        return False
    unlike = calibration.unlikeness(session.untouched)
    show(f"untouched gel: differs by {100 * unlike:.1f} % of its brightness; up to {100 * UNLIKE:.0f} % fits")
    fits = [unlike <= UNLIKE]
    if unlike > UNLIKE:
        show("another sensor or light, or an object on the gel at the start, also make it differ")
    pressed = calibration.photometric or calibration.darkness
    if pressed is not None:
        fits.append(_check_depth(calibration, pressed, session, show))
    if force_today is not None:
        watched, readings = force_today()
        assert calibration.force is not None
        now, then = (
            try_force(calibration.force, readings.name, watched, readings),
            calibration.force.press.rmse,
        )
        show(f"force: {now:.2f} N RMS from the gauge today; when it was made: {then:.2f} N")
        fits.append(now <= DRIFTED * then)
    show("it still fits" if all(fits) else "it does not fit; unless a reason above applies, calibrate again")
    return all(fits)


def _check_depth(
    calibration: Calibration, then: PhotometricEntry | DarknessEntry, session: Session, show: Show
) -> bool:
    """Compare the depth with the presses of today; True where there are none."""
    radius, scale = f"{then.ball_radius:g} mm", calibration.scale
    if not session.presses:
        show(f"no presses today: to check the depth, press a ball of radius {radius} on the untouched gel")
        return True
    if isinstance(then, DarknessEntry):
        error, limit, unit = darkness_error(session, then, scale), DRIFTED * then.stderr, "mm RMS"
        now_words = f"depth {error:.3f} mm RMS off" if math.isfinite(error) else "none can be used"
        words = now_words, darkness_words(then)
    else:
        assert calibration.slopes is not None
        now = summary(press_errors(session, calibration.slopes, scale, then.ball_radius))
        error, limit, unit = now["normal_error"], DRIFTED * then.normal_error, "degrees"
        words = photometric_words(now), photometric_words(then.model_dump())
    show(f"presses today, {len(session.presses)}: {words[0]}")
    show(f"when it was made: {words[1]}")
    if error > limit:
        others = f"few presses, a ball whose radius is not {radius}, or no untouched gel at first"
        show(f"up to {limit:.2g} {unit} fit; {others} also give larger errors")
    return error <= limit
