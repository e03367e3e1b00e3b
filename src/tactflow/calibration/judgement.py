"""Checks of the presses before a fit, and of its errors after it.

Colours alone do not tell how large a ball is, or whether it is one: any linear change of all slopes fits
other colours. Outlines do: those of a ball are round, full, and not much larger than the ball, in mm. What
else has such outlines (a cone, a pyramid, a punch) differs in how the slope grows with the distance from the
middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from tactflow.calibration.file import PhotometricEntry
from tactflow.calibration.presses import Press, Session, usual_radius
from tactflow.engine.errors import ConfigError
from tactflow.system.spelling import distinct
from tactflow.vision.arrays import Floats, Mask
from tactflow.vision.geometry.region import measure_region
from tactflow.vision.types import Scale

TINY: Final = 1e-12
"""Smallest moment of an outline that is divided by, mm^2."""
FEWEST_PRESSES: Final = 8
"""Presses from which on they must be all over the gel, and are judged by fits to the others. Chosen by
hand."""
ADVISED_PRESSES: Final = 20
"""Presses with which the error of the depth is below 23 % on eight gels."""
SPREAD: Final = 0.15
"""Least part of the picture's width and height that the presses span. Chosen by hand."""
TOO_LARGE: Final = 1.75
"""Radius of a contact, relative to that of the ball, above which no ball can have caused it. Outlines are
wider than the contact: the median is 0.46 to 1.56 on eight gels, and twice that if half of the radius is
given."""
ELONGATED: Final = 1.28
"""Median ratio of the axes of the outlines, mm, above which they are not of a ball. Balls on eight gels have
1.04 to 1.17; a body that is curved twice as much one way as the other has 1.41."""
ELONGATED_ONCE: Final = 1.6
"""The same for fewer than `FEWEST_PRESSES` presses: single ones of these balls reach 1.49."""
STRETCHED: Final = 1.12
"""Median ratio of width to height of the outlines, or of height to width, mm, above which the pixels or the
object are stretched. Unlike the longer and shorter axis, it does not grow by noise: balls on eight gels have
1.00 to 1.03."""
LEAST_FULL: Final = 0.9
"""Median area of the outlines over that of the ellipses with the same moments, below which they are hollow or
have arms. Balls on eight gels have 0.98 to 1, two balls or three faces of a corner 0.84, a ring 0.74."""
SLOPE_GROWTH: Final = (0.6, 1.4)
"""Limits of the median exponent with which the slope grows with the distance from the middle, see
`Sample.growth`: 1 for a ball, 0 for a cone. Balls on eight gels have 0.74 to 1.0; cones, pyramids and corners
of a cube on the simulator have 0.22 to 0.5, a truncated cone 1.9."""
LEAST_EXPLAINED: Final = 0.7
"""Median share of the slopes of presses that the calibration of another sensor must explain. Two faces of an
edge can explain 0.36 of the slopes of a ball, (E|x|)^2 / E(x^2 + y^2) on a disc, edges of a cube 0.26."""
LEAST_EXPLAINED_BY_OTHERS: Final = 0.85
"""The same for a fit to other presses of the session. Nine presses of balls or more have 0.93 to 0.99 on
eight gels; edges of a cube have 0.53, corners 0.79."""
LEAST_EXPLAINED_ALONE: Final = 0.83
"""The same of fewer presses, each with a fit of its own. Balls on four gels have 0.89 to 1, edges of a cube
0.59 to 0.76."""
LARGEST_ERROR: Final = 0.35
"""Relative error of depth above which a fit is refused. By hand: balls on eight gels have 0.06 to 0.22 with
twenty presses or more."""
SHALLOW: Final = 0.4
"""Median radius of the contacts over that of the ball, below which the user is asked to press deeper. Balls
on eight gels have 0.46 to 1.56."""
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
    _check_outlines(presses, scale)


def _check_outlines(presses: Sequence[Press], scale: Scale) -> None:
    """Raise ConfigError if the outlines of presses are not those of a ball.

    Those that the border of the picture cuts off do not count.
    """
    shapes = np.array([_outline(press.mask, scale) for press in presses if not _cut_off(press.mask)])
    if not len(shapes):
        return
    many = len(shapes) >= FEWEST_PRESSES
    elongation, stretch, full = np.median(shapes, axis=0).tolist()
    stretch = float(np.exp(abs(stretch)))
    # Things that lie in all directions are not stretched along one.
    common = stretch > math.sqrt(elongation)
    if common and stretch > (STRETCHED if many else ELONGATED_ONCE):
        raise ConfigError(
            f"calibrate: the contacts are {stretch:.2f} times as long in one direction of the picture as in "
            "the other, in mm, and those of a ball are round: the object is not a ball, or pixels are not "
            f"{scale.x:.4g} x {scale.y:.4g} mm; give --area WIDTH HEIGHT in this order"
        )
    if elongation > (ELONGATED if many else ELONGATED_ONCE):
        raise ConfigError(
            f"calibrate: the contacts are {elongation:.2f} times as long as wide in the median, and those of "
            "a ball are round: the object is not a ball, or its outline is not found (`--view`)"
        )
    if full < LEAST_FULL:
        raise ConfigError(
            f"calibrate: the contacts fill {100 * full:.0f} % of their outline in the median, those of a "
            "ball all of it: the object is not a ball, or its outline is not found (`--view`)"
        )


def _outline(mask: Mask, scale: Scale) -> tuple[float, float, float]:
    """Longer over shorter axis; logarithm of width over height; area over that of the ellipse with the same
    moments. mask : (H, W) uint8, 255 in contact; not all 0."""
    region = measure_region(mask)
    moments = region.moments()
    wide, high = moments.xx * scale.x**2, moments.yy * scale.y**2
    slanted = moments.xy * scale.x * scale.y
    ellipse = math.sqrt(max(wide * high - slanted**2, TINY))
    spread = math.hypot((wide - high) / 2, slanted)
    middle = (wide + high) / 2
    elongation = math.sqrt((middle + spread) / max(middle - spread, TINY))
    area = region.pixels * scale.area(1.0)
    return elongation, 0.5 * math.log(max(wide, TINY) / max(high, TINY)), area / (4 * math.pi * ellipse)


def _cut_off(mask: Mask) -> bool:
    """Whether the border of the picture cuts a contact off."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def check_growth(growths: Floats) -> None:
    """Raise ConfigError if the slope does not grow with the distance from the middle as that of a ball.

    growths : (n,) exponents of the presses, `Sample.growth`; NaN where a contact is too small.
    """
    known = growths[np.isfinite(growths)]
    least, most = SLOPE_GROWTH
    if len(known) and not least <= (growth := float(np.median(known))) <= most:
        raise ConfigError(
            "calibrate: from the middle of a contact to its rim the slope does not grow as that of a ball "
            f"(exponent {growth:.2f}; required {least:g} to {most:g}): the object is pointed or flat, and "
            "not a ball"
        )


def check_explained(explained: float, least: float = LEAST_EXPLAINED) -> None:
    """Raise ConfigError if too little of the slopes is explained for presses of a ball."""
    if explained < least:
        share, limit = distinct(100 * explained, 100 * least)
        raise ConfigError(
            f"calibrate: the colours explain {share} % of the slopes that a ball would "
            f"have ({limit} % required): the object is not a ball, nothing "
            "touches the gel, or its colour does not depend on the slope"
        )


def check_error(found: PhotometricEntry) -> None:
    """Raise ConfigError if the error of the depth is too large although there are enough presses, with
    possible causes."""
    if found.depth_stderr > LARGEST_ERROR and found.presses >= FEWEST_PRESSES:
        error, limit = distinct(100 * found.depth_stderr, 100 * LARGEST_ERROR)
        more = "" if found.presses >= ADVISED_PRESSES else f"press {ADVISED_PRESSES} times or more, "
        raise ConfigError(
            f"calibrate: the error of the depth would be {error} % ({limit} % at most); {more}press all over "
            "the gel, with nothing but the ball, and see whether its outline is found (`--view`)"
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
    if 2 * contact > TOO_LARGE * ball_radius:
        # A ball of half this radius could not make such contacts.
        return None
    deep = ball_radius - (ball_radius**2 - contact**2) ** 0.5
    question = (
        f"{ask} Its contacts have a radius of {contact:.2f} mm in the median, which fits both; with this "
        f"radius it was pressed {deep:.2f} mm deep"
    )
    return question if contact >= SHALLOW * ball_radius else f"{question}; if that is right, press deeper"
