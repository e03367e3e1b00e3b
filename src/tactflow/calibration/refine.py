"""Slopes of a sensor from those of another one of its kind, and a few presses of a ball."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from tactflow.calibration.file import Calibration, PhotometricEntry
from tactflow.calibration.judgement import LEAST_EXPLAINED, check_error, check_explained, check_presses
from tactflow.calibration.photometric import RIDGE, Photometry
from tactflow.calibration.presses import Session
from tactflow.calibration.samples import TURNS, Misfit, Sample, errors_on, flat, prepared, shaped, summary
from tactflow.engine.errors import ConfigError
from tactflow.vision.arrays import Floats
from tactflow.vision.depth.slopes import SlopeModel
from tactflow.vision.types import Scale

MAP_WEIGHT: Final = 0.3
"""Weight of the prior of the difference between two sensors, in presses: normals differ by some 10 %, which a
press shows to 5 or 6 %; the squared ratio is 0.3."""
BASE_WEIGHT: Final = 3.0
"""Weight of the prior of the coefficients. With 1 to 10, errors after 1, 3 and 9 presses of two Minis differ
by a tenth at most."""


def refine_photometry(session: Session, scale: Scale, ball_radius: float, base: Calibration) -> Photometry:
    """Adapt the slopes of another sensor of the same kind to this one, by one press of a ball or more.

    Bayesian linear regression, in two steps. Other lamps scale or rotate the slopes, so first all normals are
    mapped by one 2 x 2 matrix, which one press determines. Then the coefficients are fitted: the mean of
    their prior is the mapped ones, and its precision is proportional to the Gram matrix of the presses that
    the base was learned from, so more presses adapt more of the dependence on position and colour.

    Presses that do not look like a ball to the base are left out. base : with slopes. The other parameters
    are those of `fit_photometry`.

    Raises ConfigError without presses, if most are not of a ball, or contacts are larger than the ball.
    """
    if base.slopes is None or base.photometric is None or base.information is None:
        raise ConfigError("calibrate --refine: required a calibration with depth")
    radii = np.full(len(session.presses), ball_radius)
    check_presses(session, scale, radii, fewest=1)
    samples = prepared(session, scale, radii)
    start = flat(base.slopes)
    explained = np.array([_by_base(sample, start).explained for sample in samples])
    check_explained(float(np.median(explained)))
    kept = explained >= LEAST_EXPLAINED
    good = np.flatnonzero(kept)
    weights = _refined([samples[i] for i in good], start, base.information)
    centers = np.array([sample.center(sample.start, weights) for sample in samples])
    misfit = np.array([s.misfit(c, weights).angle for s, c in zip(samples, centers, strict=True)])
    before, count = base.photometric, len(good)
    errors = []
    for number in good.tolist():
        # There is nothing to cross-validate a single press with.
        others = [samples[i] for i in good if i != number or count == 1]
        errors += errors_on(session, samples, [number], _refined(others, start, base.information), scale)
    left_out = summary(errors)

    def with_base(name: str) -> float:
        # The known error of the base counts as one press more.
        return float(np.sqrt((getattr(before, name) ** 2 + count * left_out[name] ** 2) / (1 + count)))

    found = PhotometricEntry(
        ball_radius=ball_radius,
        presses=count,
        rejected=len(samples) - count,
        steepest=max(before.steepest or 0.0, *(samples[i].reach / samples[i].ball_radius for i in good)),
        explained=float(np.median(explained)),
        between=before.between / (1 + count) ** 0.5,
        normal_error=with_base("normal_error"),
        depth_stderr=with_base("depth_stderr"),
    )
    check_error(found)
    pixels = centers / (scale.x, scale.y) + scale.origin
    return Photometry(SlopeModel(shaped(weights)), base.information, found, pixels, kept, misfit)


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
            found.T @ found + MAP_WEIGHT * start @ information @ start.T, found.T @ (normals - found)
        )
        mapped = start + step.T @ start
        misfit = terms.T @ (normals - terms @ mapped.T)
        weights = mapped + np.linalg.solve(terms.T @ terms + BASE_WEIGHT * known, misfit).T
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
