"""Slopes of a sensor from those of another one of its kind, and a few presses of a ball."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import Calibration, PhotometricEntry
from tactflow.calibration.judgement import LEAST_EXPLAINED, check_error, check_explained, check_presses
from tactflow.calibration.photometric import RIDGE, Photometry, fit_photometry, left_out
from tactflow.calibration.presses import Session
from tactflow.calibration.samples import (
    TURNS,
    Misfit,
    Sample,
    core_ratio,
    errors_on,
    flat,
    prepared,
    shaped,
    summary,
)
from tactflow.engine.errors import ConfigError
from tactflow.vision.arrays import Floats
from tactflow.vision.depth.slopes import SlopeModel
from tactflow.vision.types import Scale

MAP_WEIGHT_PRESSES: Final = 0.3
"""Weight of the prior of the difference between two sensors, in presses: normals differ by some 10 %, which a
press shows to 5 or 6 %; the squared ratio is 0.3."""
BASE_WEIGHT_PRESSES: Final = 3.0
"""Weight of the prior of the coefficients. With 1 to 10, errors after 1, 3 and 9 presses of two Minis differ
by a tenth at most."""
SHARE_AFTER_ONE_PRESS: Final = 0.5
"""Part of a default's error that is left after one press, beside the error of the press itself. On three
Minis 0.4 to 0.9 of the error of the depth remain in all, and 0.6 to 0.9 of that of the normals."""


def refine_photometry(session: Session, scale: Scale, ball_radius: float, base: Calibration) -> Photometry:
    """Adapt the slopes of another sensor of the same kind to this one, by one press of a ball or more.

    Bayesian linear regression, in two steps. Other lamps scale or rotate the slopes, so first all normals are
    mapped by one 2 x 2 matrix, which one press determines. Then the coefficients are fitted: the mean of
    their prior is the mapped ones, and its precision is proportional to the Gram matrix of the presses that
    the base was learned from, so more presses adapt more of the dependence on position and colour.

    Beside it the slopes are fitted from scratch, and from two presses on the better fit is kept, by its
    normals on presses left out. Presses that do not look like a ball to the base are left out.

    base : with slopes. The other parameters are those of `fit_photometry`.

    Raises ConfigError without presses, if most are not of a ball, or contacts are larger than the ball.
    """
    if base.slopes is None or base.photometric is None or base.information is None:
        raise ConfigError("calibrate --refine: required a calibration with depth")
    radii = np.full(len(session.presses), ball_radius)
    check_presses(session, scale, radii)
    samples = prepared(session, scale, radii)
    start = flat(base.slopes)
    explained = np.array([_by_base(sample, start).explained for sample in samples])
    check_explained(float(np.median(explained)))
    refined = _refinement(session, scale, samples, explained, base)
    if refined.found.presses > 1:
        # Where a fit from scratch fails, the refinement stands.
        with suppress(ConfigError):
            fresh = fit_photometry(session, scale, ball_radius)
            if fresh.found.normal_error < refined.found.normal_error:
                return fresh
    check_error(refined.found)
    return refined


def _refinement(
    session: Session, scale: Scale, samples: Sequence[Sample], explained: Floats, base: Calibration
) -> Photometry:
    """The refined base. samples : of all presses. explained : (n,), share of each that the base explains."""
    assert base.slopes is not None
    assert base.photometric is not None
    assert base.information is not None
    start, information, before = flat(base.slopes), base.information, base.photometric
    kept = explained >= LEAST_EXPLAINED
    good = np.flatnonzero(kept)

    def fit(chosen: NDArray[np.intp]) -> Floats:
        return _refined([samples[i] for i in chosen.tolist()], start, information)

    weights = fit(good)
    centers = np.array([sample.center(sample.start, weights) for sample in samples])
    misfit = np.array([s.misfit(c, weights).angle for s, c in zip(samples, centers, strict=True)])
    if len(good) > 1:
        errors = left_out(session, samples, good, scale, fit)
    else:
        # Nothing is left out of a single press.
        errors = summary(errors_on(session, samples, good.tolist(), weights, scale))
        for name in ("normal_error", "depth_stderr"):
            errors[name] = math.hypot(SHARE_AFTER_ONE_PRESS * getattr(before, name), errors[name])
    found = PhotometricEntry(
        ball_radius=samples[0].ball_radius,
        presses=len(good),
        rejected=len(samples) - len(good),
        steepest=max(
            before.steepest or 0.0, *(samples[i].reach / samples[i].ball_radius for i in good.tolist())
        ),
        between=before.between * SHARE_AFTER_ONE_PRESS / math.sqrt(len(good)),
        core_ratio=core_ratio(session, samples, good.tolist(), weights, scale),
        **errors,
    )
    pixels = centers / (scale.x, scale.y) + scale.origin
    return Photometry(SlopeModel(shaped(weights)), information, found, pixels, kept, misfit)


def _refined(samples: Sequence[Sample], start: Floats, information: Floats) -> Floats:
    """Coefficients (2, 114) of `refine_photometry`. start : (2, 114). information : of `Photometry`."""
    known = information + RIDGE * np.diag(np.diag(information))
    weights = start
    for _ in range(TURNS):
        seen, true = [], []
        for sample in samples:
            center = sample.center(sample.start, weights)
            ball = sample.on_ball(center)
            seen.append(sample.terms[ball].astype(np.float64))
            true.append(sample.true_normals(center, ball))
        terms, normals = np.concatenate(seen), np.concatenate(true)
        found = terms @ start.T
        step = np.linalg.solve(
            found.T @ found + MAP_WEIGHT_PRESSES * start @ information @ start.T, found.T @ (normals - found)
        )
        mapped = start + step.T @ start
        misfit = terms.T @ (normals - terms @ mapped.T)
        weights = mapped + np.linalg.solve(terms.T @ terms + BASE_WEIGHT_PRESSES * known, misfit).T
    return weights


def apparent_radius(session: Session, scale: Scale, ball_radius: float, base: Calibration) -> float:
    """Radius of the ball according to the slopes of another sensor of the kind, mm, median of the presses.

    The presses alone do not determine it: with twice the radius all slopes are half as steep. ball_radius :
    as given, mm. base : with slopes.
    """
    assert base.slopes is not None
    start, radii = flat(base.slopes), np.full(len(session.presses), ball_radius)
    gains = [_by_base(sample, start).gain for sample in prepared(session, scale, radii)]
    return ball_radius * float(np.median(gains))


def _by_base(sample: Sample, start: Floats) -> Misfit:
    """How well the coefficients of the base, (2, 114), fit a press."""
    return sample.misfit(sample.center(sample.start, start), start)
