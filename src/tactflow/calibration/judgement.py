"""Checks of the presses before a fit, and of its errors after it."""

from __future__ import annotations

from typing import Final

import numpy as np

from tactflow.calibration.file import PhotometricEntry
from tactflow.calibration.presses import Session, usual_radius
from tactflow.engine.errors import ConfigError
from tactflow.system.spelling import distinct
from tactflow.vision.arrays import Floats
from tactflow.vision.types import Scale

FEWEST_PRESSES: Final = 8
"""Presses from which on they must be all over the gel, and each half of them can judge the other; 20 or more
are advised. Chosen by hand."""
SPREAD: Final = 0.15
"""Least part of the picture's width and height that the presses span. Chosen by hand."""
TOO_LARGE: Final = 2.0
"""Radius of a contact, relative to that of the ball, above which no ball can have caused it. Outlines are
wider than the contact: the median is 0.46 to 1.55 on five gels."""
LEAST_EXPLAINED: Final = 0.7
"""Median share of the slopes of presses that a fit to others must explain. Two faces of an edge can explain
0.36 of the slopes of a ball, (E|x|)^2 / E(x^2 + y^2) on a disc. Balls on five gels have 0.94 to 0.99, edges
of a cube 0.53 with their own fit and 0.26 with that of a ball."""
LEAST_EXPLAINED_ALONE: Final = 0.83
"""The same of fewer presses, each with a fit of its own. Balls on four gels have 0.89 to 1, edges of a cube
0.59 to 0.76."""
LARGEST_ERROR: Final = 0.35
"""Relative error of depth above which a fit is refused. By hand: balls on five gels have 0.04 to 0.14."""
SHALLOW: Final = 0.4
"""Median radius of the contacts over that of the ball, below which the user is asked whether the diameter was
given. Balls on five gels have 0.46 to 1.55, half of that with the diameter."""
OTHER_RADIUS: Final = 2**0.5
"""Factor between the given radius and the one measured with the calibration of the kind, above which the user
is asked: half way to a diameter. Single presses on two Minis and a DIGIT have 0.9 to 1.3."""


def check_presses(session: Session, scale: Scale, radii: Floats) -> None:
    """Raise ConfigError if the presses cannot give a calibration, with what was found and what to do.

    radii : (n,) float64, of the ball of each press, mm. `FEWEST_PRESSES` or more must be all over the gel.
    """
    presses = session.presses
    if not (np.isfinite(radii) & (radii > 0)).all():
        raise ConfigError(f"calibrate: required a ball radius > 0 mm, got {radii.min():g}")
    if not presses:
        raise ConfigError(
            f"calibrate: nothing touched the gel in {session.frames} frames; the first frame must show it "
            "untouched, the others presses of the ball"
        )
    span = np.ptp([press.center for press in presses], axis=0) / session.mapping.size
    if span.min() < SPREAD and len(presses) >= FEWEST_PRESSES:
        # Rounded down, so that the message cannot show the required value.
        wide, high = np.floor(1000 * span) / 10
        raise ConfigError(
            f"calibrate: the presses span {wide:g} % of the picture's width and "
            f"{high:g} % of its height, required {100 * SPREAD:.0f} %; press all over the gel"
        )
    radius = usual_radius(presses) * (scale.x * scale.y) ** 0.5
    ball_radius = float(np.median(radii))
    if radius > TOO_LARGE * ball_radius:
        raise ConfigError(
            f"calibrate: the contacts have a radius of {radius:.2f} mm in the median, which a ball of radius "
            f"{ball_radius:g} mm cannot make; give its radius, not its diameter, in mm, and look at the scale"
        )


def check_explained(explained: float, least: float = LEAST_EXPLAINED) -> None:
    """Raise ConfigError if too little of the slopes is explained for presses of a ball."""
    if explained < least:
        share, required = distinct(100 * explained, 100 * least)
        raise ConfigError(
            f"calibrate: the colours explain {share} % of the slopes that a ball would "
            f"have ({required} % required): the object is not a ball, nothing "
            "touches the gel, or its colour does not depend on the slope"
        )


def check_error(found: PhotometricEntry) -> None:
    """Raise ConfigError if the error of the depth is too large although there are enough presses, with
    possible causes."""
    if found.depth_stderr > LARGEST_ERROR and found.presses >= FEWEST_PRESSES:
        error, limit = distinct(100 * found.depth_stderr, 100 * LARGEST_ERROR)
        raise ConfigError(
            f"calibrate: the error of the depth would be {error} % ({limit} % at most); press all over the "
            "gel, with nothing but the ball, and see whether its outline is found (`--view`)"
        )


def doubt(session: Session, scale: Scale, ball_radius: float, apparent: float | None = None) -> str | None:
    """A question to the user about the radius of the ball, or None.

    ball_radius : mm, as given. apparent : `apparent_radius`, mm, if there is a calibration of the kind.
    """
    ask = f"is {ball_radius:g} mm the radius of this ball, and not its diameter?"
    if apparent is not None:
        if max(apparent / ball_radius, ball_radius / apparent) < OTHER_RADIUS:
            return None
        return f"{ask} By the calibration of the pipeline, its radius is about {apparent:.2g} mm"
    contact = usual_radius(session.presses) * (scale.x * scale.y) ** 0.5
    if contact >= SHALLOW * ball_radius:
        return None
    deep = ball_radius - (ball_radius**2 - contact**2) ** 0.5
    return (
        f"{ask} Its contacts have a radius of {contact:.2f} mm in the median, so it was pressed {deep:.2f} "
        "mm deep; if that is right, press deeper"
    )
