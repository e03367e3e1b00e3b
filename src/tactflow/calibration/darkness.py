"""Depth of a gel from its darkening, learned from one press of a ball or more.

Inside a contact the surface is the ball: at a distance d from the middle of a ball of radius R whose contact
has the radius c, the depth below the untouched gel is sqrt(R^2 - d^2) - sqrt(R^2 - c^2). Means over rings
around the middle give the darkening for each depth, and isotonic regression makes it a monotone function.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import DarknessEntry
from tactflow.calibration.judgement import LEAST_EXPLAINED, TOO_LARGE, check_presses
from tactflow.calibration.presses import Press, Session
from tactflow.calibration.samples import reach
from tactflow.engine.errors import ConfigError
from tactflow.vision.arrays import Floats
from tactflow.vision.depth.darkness import DarknessModel
from tactflow.vision.depth.surface import Rest, colour_change, half_resolution
from tactflow.vision.depth.surroundings import surroundings
from tactflow.vision.types import Scale

MIN_RINGS: Final = 4
"""Rings, one pixel at half resolution wide, that a contact must have."""


class Ring(NamedTuple):
    """Part of a press at one distance from its middle.

    Attributes
    ----------
    depth : mm, of the ball.
    darkening : relative, of its first and its second half.
    """

    depth: float
    darkening: tuple[float, float]


class Darkness(NamedTuple):
    """A fit.

    Attributes
    ----------
    found : numbers for the calibration file.
    kept : (n,) bool, which presses were used.
    misfit : (n,) float64, RMS error of the depth of each press, mm; infinite where it is unusable.
    """

    found: DarknessEntry
    kept: NDArray[np.bool_]
    misfit: Floats


def fit_darkness(session: Session, scale: Scale, ball_radius: float) -> Darkness:
    """Learn depth from darkening.

    The stated error is that of each press by the others; of a single press, of either half by the other.

    session : what `PressFinder` found. scale : mm per px. ball_radius : mm.

    Raises ConfigError without presses, for contacts larger than the ball or too small, and for a gel that
    does not become darker with the depth.
    """
    check_presses(session, scale, np.full(len(session.presses), ball_radius))
    rest = Rest(session.untouched)
    presses = [_rings(press, rest, scale, ball_radius) for press in session.presses]
    kept = np.array([len(rings) >= MIN_RINGS for rings in presses])
    good = [rings for rings in presses if len(rings) >= MIN_RINGS]
    if not good:
        raise ConfigError(
            "calibrate: the contacts are too small, or much larger than the ball: press deeper, and see "
            "whether their outline is found (`--view`)"
        )
    darkening, depth = _curve([ring for rings in good for ring in rings], (0, 1))
    errors = _held_out(good)
    misfit = np.full(len(presses), np.inf)
    misfit[kept] = errors
    found = DarknessEntry(
        ball_radius=ball_radius,
        presses=len(good),
        darkening=darkening.tolist(),
        depth=depth.tolist(),
        stderr=float(np.sqrt(np.mean(errors**2))),
    )
    return Darkness(found, kept, misfit)


def darkness_error(session: Session, entry: DarknessEntry, scale: Scale) -> float:
    """RMS error of the depth on presses of the ball of a calibration, mm; infinite where none is usable."""
    rest, model = Rest(session.untouched), entry.model()
    presses = [_rings(press, rest, scale, entry.ball_radius) for press in session.presses]
    errors = [_rms(rings, model, half) for rings in presses if rings for half in (0, 1)]
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("inf")


def _rings(press: Press, rest: Rest, scale: Scale, ball_radius: float) -> list[Ring]:
    """Rings of a press, from the middle outwards; empty if the contact is too large for the ball."""
    contact = press.radius * (scale.x * scale.y) ** 0.5
    if contact > TOO_LARGE * ball_radius:
        return []
    contact = min(contact, ball_radius)
    fall = float(np.sqrt(ball_radius**2 - contact**2))
    window = surroundings(press.mask, rest.window).window
    half = half_resolution(press.image)
    gain = rest.around(half, press.mask).gain
    darkening = -colour_change(half, rest, window, gain).mean(axis=2)
    rows, columns = np.mgrid[window.part]
    # The centre of a pixel at half resolution lies between two of the processed frame.
    x, y = (2 * columns + 0.5 - press.center[0]) * scale.x, (2 * rows + 0.5 - press.center[1]) * scale.y
    distance, step = np.hypot(x, y), 2 * max(scale.x, scale.y)
    hidden = press.hidden[window.whole][::2, ::2]
    rings = []
    for number in range(int(reach(press, scale, ball_radius) / step)):
        ring = (distance >= number * step) & (distance < (number + 1) * step) & ~hidden
        halves = darkening[ring & (x >= 0)], darkening[ring & (x < 0)]
        if min(half.size for half in halves) == 0:
            continue
        ball = np.sqrt(ball_radius**2 - distance[ring] ** 2).mean()
        rings.append(Ring(float(ball) - fall, (float(halves[0].mean()), float(halves[1].mean()))))
    return rings


def _curve(rings: Sequence[Ring], halves: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Darkening and depth (n,), both increasing and above 0, by isotonic regression of the darkening.

    Raises ConfigError where the darkening does not follow the depth.
    """
    from scipy.optimize import isotonic_regression

    depth = np.array([ring.depth for ring in rings])
    darkening = np.array([np.mean([ring.darkening[half] for half in halves]) for ring in rings])
    order = np.argsort(depth)
    depth, darkening = depth[order], darkening[order]
    fitted = np.asarray(isotonic_regression(darkening).x)
    explained = np.var(darkening - fitted) <= (1 - LEAST_EXPLAINED) * np.var(darkening)
    levels, block = np.unique(np.round(fitted, 9), return_inverse=True)
    depths = np.bincount(block, depth) / np.bincount(block)
    above = (levels > 0) & (depths > 0)
    if not explained or np.count_nonzero(above) < MIN_RINGS - 1:
        raise ConfigError(
            "calibrate --darkness: this gel does not become darker the deeper the ball presses; where it "
            "answers with colour, calibrate without --darkness"
        )
    return levels[above], depths[above]


def _held_out(presses: Sequence[Sequence[Ring]]) -> Floats:
    """(n,): cross-validated RMS error of the depth of each press, mm.

    It is judged down to the depth of the other presses; if that is less than a few rings, one half of it is
    judged by the other.
    """
    errors = []
    for number, press in enumerate(presses):
        others = [ring for i, rings in enumerate(presses) if i != number for ring in rings]
        deepest = max((ring.depth for ring in others), default=0.0)
        judged = [ring for ring in press if ring.depth <= deepest]
        if len(judged) >= MIN_RINGS:
            learned = [_curve(others, (0, 1))] * 2
        else:
            judged, learned = list(press), [_curve(press, (half,)) for half in (1, 0)]
        halves = [_rms(judged, DarknessModel(*curve), half) for half, curve in enumerate(learned)]
        errors.append(float(np.sqrt(np.mean(np.square(halves)))))
    return np.array(errors)


def _rms(press: Sequence[Ring], model: DarknessModel, half: int) -> float:
    """RMS error of the depth of one half of a press, mm."""
    depth = np.array([ring.depth for ring in press])
    found = model(np.array([ring.darkening[half] for ring in press]))
    return float(np.sqrt(np.mean((found - depth) ** 2)))
