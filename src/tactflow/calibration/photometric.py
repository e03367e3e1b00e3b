"""Which colour of the gel is which slope, learned from presses of a ball.

Where the ball touches, the surface is the ball: at a distance d from the middle of a ball of radius R the
horizontal part of the unit normal is d / R, towards the middle. The outline gives the middle to a few pixels
only, so fit and centres alternate: with a model, each pixel of a press estimates the middle, and the median
is the press's new centre. A common offset of the centres shows as a slope of the unchanged colour, which has
none.

Around the ball, all that is known of the slope is its symmetry: it is the same all around and points to the
middle. Shadows and reflections on one side would break it, and with it the heights, which are integrals of
the slopes, so the symmetry is part of the fit. On wedge_ball it halves the RMS distance of the heights from
the ball.

All of this is linear in the coefficients: a ridge regression with a few hundred unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import PhotometricEntry
from tactflow.calibration.judgement import (
    FEWEST_PRESSES,
    LEAST_EXPLAINED_ALONE,
    LEAST_EXPLAINED_BY_OTHERS,
    check_error,
    check_explained,
    check_growth,
    check_presses,
)
from tactflow.calibration.presses import Session
from tactflow.calibration.samples import TURNS, Sample, core_ratio, errors_on, prepared, shaped, summary
from tactflow.vision.arrays import Floats
from tactflow.vision.depth.slopes import COLOUR_TERMS, PLACE_TERMS, SlopeModel
from tactflow.vision.types import Scale

ROUND: Final = 0.05
"""Weight of a pixel around the contact relative to one inside. Chosen on wedge_ball: 0.03 leaves 0.033 mm RMS
and 0.1 flattens the ball."""
RIDGE: Final = 1e-6
"""Ridge penalty, as a part of a coefficient's own weight. Chosen by hand."""
PLACE_RIDGE: Final = 1e-3
"""The same for coefficients that depend on the position, so that a colour means much the same where nothing
was pressed. Chosen on the simulator: after 8 presses normals under `mixed` are 55 degrees off with 1e-6, 13
with 1e-4, 7 with 1e-3; with 1e-2 heights of a box are off by 9 % after 26 presses, instead of 7."""
CHANNELS: Final = 3
"""Terms of the colour that are a channel itself, not a product."""
SINGLE_RIDGE: Final = 10.0
"""Ridge penalty, for a single press, of coefficients that depend on the position, of which it shows one, and
of products of channels, which it shows few of. It falls with the cube of the number of presses. Elsewhere
on two DIGITs and a Mini, normals by a single press are 8, 14 and 6 degrees off in the mean, instead of 17, 18
and 6 with a tenth of it; from twenty presses on the fit is as good as without it."""
SINGLE_CHANNEL_RIDGE: Final = 0.1
"""The same of the three channels themselves, whose differences a single press may hardly show."""
SINGLE_PRESS_ERRORS: Final[Mapping[str, float]] = {"normal_error": 8.5, "depth_stderr": 0.25}
"""Errors of a calibration by a single press: of the normals, degrees, and of the depth, relative. Measured on
presses elsewhere on two DIGITs and four Minis (`python -m lab.default_calibrations --judge`)."""
OUTLIER: Final = 4.0
"""Robust standard deviations above the median misfit at which a press is rejected. Chosen by hand."""
LEAST_SCATTER: Final = 0.1
"""Lower limit of the standard deviation of the misfits, degrees. Chosen by hand."""
FREE_PRESSES: Final = 1000
"""Presses whose ridge penalty lets a fit show the shape of the object: that of a few bends any object towards
a ball, so that the slope of a cone seems to grow with an exponent of 0.7 instead of 0.5."""
ENOUGH_FOR_HALVES: Final = 24
"""Presses from which each half is judged by a fit to the other. With fewer, an eighth is left out in turn: a
fit to four presses explains 0.51 to 0.98 of balls on seven gels, one to eight of them 0.93 to 0.99."""
ROUNDS: Final = 2
"""How often outliers are rejected: a fit that includes bad presses makes good ones look bad, too."""


@dataclass(frozen=True, eq=False, slots=True)
class Photometry:
    """A fit.

    model : of the slopes. information : (114, 114) float64, Gram matrix of the terms, mean of the presses:
    how well a press determines the coefficients. found : numbers for the calibration file. centers : (n, 2)
    float64, px, of the presses. kept : (n,) bool, which were not rejected. misfit : (n,) float64, mean angle
    between the normals of each press and its ball, degrees.
    """

    model: SlopeModel
    information: Floats
    found: PhotometricEntry
    centers: Floats
    kept: NDArray[np.bool_]
    misfit: Floats


def fit_photometry(session: Session, scale: Scale, ball_radius: float | Sequence[float]) -> Photometry:
    """Learn slopes from presses of one ball or several; a single press is enough for a first calibration.

    From `FEWEST_PRESSES` on, outliers are rejected. The errors are those of presses that a fit has not seen:
    see `left_out`, and of a single press those that single presses had on other sensors.

    session : what `PressFinder` found. scale : mm per px. ball_radius : mm, of all presses or of each.

    Raises ConfigError without presses, with many in one place, larger than the ball, not of a ball,
    or stretched by a wrong scale.
    """
    radii = np.broadcast_to(np.asarray(ball_radius, np.float64), len(session.presses))
    check_presses(session, scale, radii)
    samples = prepared(session, scale, radii)
    kept = np.ones(len(samples), np.bool_)
    for _ in range(ROUNDS):
        weights, starts = _fit(samples, np.flatnonzero(kept))
        fitted = [sample.center(start, weights) for sample, start in zip(samples, starts, strict=True)]
        centers = np.array(fitted)
        misfit = np.array([s.misfit(c, weights).angle for s, c in zip(samples, centers, strict=True)])
        before, kept = kept, _fitting(misfit) if len(samples) >= FEWEST_PRESSES else kept
        if (kept == before).all():
            break
    else:
        weights, _ = _fit(samples, np.flatnonzero(kept))
    good = np.flatnonzero(kept)
    errors: dict[str, float] = dict(SINGLE_PRESS_ERRORS)
    if len(good) > 1:
        errors = left_out(session, samples, good, scale, lambda chosen: _fit(samples, chosen)[0])
    if len(good) < FEWEST_PRESSES:
        # Where the light differs from place to place, few presses of a ball do not explain each other.
        alone = [sample.explained_alone(sample.start) for sample in samples]
        errors["explained"] = float(np.median(alone))
        check_explained(errors["explained"], LEAST_EXPLAINED_ALONE)
    else:
        check_explained(errors["explained"], LEAST_EXPLAINED_BY_OTHERS)
        free, starts = _fit(samples, good, ridge_for=FREE_PRESSES)
        middles = [samples[i].center(starts[i], free) for i in good]
        growths = [samples[i].growth(middle, free) for i, middle in zip(good, middles, strict=True)]
        check_growth(np.array(growths))
    found = PhotometricEntry(
        ball_radius=float(np.median(radii)),
        presses=len(good),
        rejected=len(samples) - len(good),
        steepest=max(samples[i].reach / samples[i].ball_radius for i in good),
        # What few presses leave open is nearly the same in all frames.
        between=errors["depth_stderr"] if len(good) < FEWEST_PRESSES else 0.0,
        core_ratio=core_ratio(session, samples, good.tolist(), weights, scale),
        **errors,
    )
    check_error(found)
    pixels = centers / (scale.x, scale.y) + scale.origin
    information = np.mean([samples[i].information(centers[i]) for i in good], axis=0)
    return Photometry(SlopeModel(shaped(weights)), information, found, pixels, kept, misfit)


def _fitting(misfit: Floats) -> NDArray[np.bool_]:
    """(n,): which presses are not outliers."""
    from scipy.stats import median_abs_deviation

    scatter = float(median_abs_deviation(misfit, scale="normal"))
    return np.asarray(misfit <= np.median(misfit) + OUTLIER * max(scatter, LEAST_SCATTER))


def _fit(
    samples: Sequence[Sample], chosen: NDArray[np.intp], ridge_for: int | None = None
) -> tuple[Floats, Floats]:
    """Coefficients (2, 114), and the centres (n, 2), mm, of all samples, from the chosen ones.

    ridge_for : number of presses that the ridge penalty is for; default: that of the chosen ones.
    """
    centers = np.array([sample.start for sample in samples])
    for turn in range(TURNS):
        weights, offset = _solve([(samples[i], centers[i]) for i in chosen], ridge_for or len(chosen))
        if turn < TURNS - 1:
            centers += offset
            centers[chosen] = [samples[i].center(centers[i], weights) for i in chosen]
    return weights, centers


def _solve(presses: Sequence[tuple[Sample, Floats]], ridge_for: int) -> tuple[Floats, Floats]:
    """Coefficients (2, 114) for given centres, and their common offset, (2,) mm. ridge_for : see `_fit`.

    The offset is the coefficient of a constant beside the terms: the slope of the unchanged colour.
    """
    count = PLACE_TERMS * COLOUR_TERMS
    inside = np.zeros((count + 1, count + 1))
    aim = np.zeros((2, count + 1))
    around = np.zeros((2 * count, 2 * count))
    for sample, center in presses:
        dx, dy = sample.x - center[0], sample.y - center[1]
        ball = sample.on_ball(center)
        # A common offset of the centres tilts a small ball's normals more.
        shifted = np.full(np.count_nonzero(ball), 1 / sample.ball_radius, np.float32)
        terms = np.column_stack([sample.terms[ball], shifted])
        inside += terms.T @ terms
        aim += np.stack([dx[ball], dy[ball]]) / sample.ball_radius @ terms
        outer = np.flatnonzero(~sample.hidden & ~ball & sample.inner)
        around += _roundness(sample.terms[outer], dx[outer], dy[outer])
    matrix = np.kron(np.eye(2), inside)
    free = np.flatnonzero(np.arange(2 * count + 2) % (count + 1) < count)
    matrix[np.ix_(free, free)] += ROUND * around
    ridge = np.append(_ridge(ridge_for), RIDGE)
    matrix += np.diag(np.tile(ridge, 2) * np.diag(matrix) + 1e-9 * np.trace(matrix) / len(matrix))
    solved = np.linalg.solve(matrix, aim.ravel()).reshape(2, count + 1)
    return solved[:, :count], solved[:, count]


def _ridge(presses: int) -> Floats:
    """(114,): ridge penalty of each coefficient, as a part of its own weight, for a number of presses."""
    few = 1 / presses**3
    place = np.array([0.0] + [max(PLACE_RIDGE, SINGLE_RIDGE * few)] * (PLACE_TERMS - 1))
    colour = np.full(COLOUR_TERMS, max(RIDGE, SINGLE_RIDGE * few))
    colour[:CHANNELS] = max(RIDGE, SINGLE_CHANNEL_RIDGE * few)
    return np.asarray(np.maximum(place[:, None], colour).ravel())


def _roundness(terms: NDArray[np.float32], dx: Floats, dy: Floats) -> Floats:
    """(228, 228): quadratic form that is 0 for normals that point to the middle and are the same all
    around."""
    distance = np.hypot(dx, dy)
    ux, uy = ((part / distance).astype(np.float32)[:, None] for part in (dx, dy))
    across = np.concatenate([-uy * terms, ux * terms], axis=1)
    along = np.concatenate([ux * terms, uy * terms], axis=1)
    # Rings as wide as two pixels at half resolution.
    width = 2 * float(np.abs(np.diff(np.unique(np.round(dx, 6)))).min()) if len(dx) > 1 else 1.0
    ring = (distance / width).astype(np.int64)
    order = np.argsort(ring, kind="stable")
    ring, along = ring[order], along[order]
    first = np.flatnonzero(np.diff(ring, prepend=-1))
    members = np.diff(first, append=len(ring))
    means = np.add.reduceat(along, first, axis=0) / members[:, None].astype(np.float32)
    along -= np.repeat(means, members, axis=0)
    return np.asarray(across.T @ across + along.T @ along, np.float64)


def left_out(
    session: Session,
    samples: Sequence[Sample],
    good: NDArray[np.intp],
    scale: Scale,
    fit: Callable[[NDArray[np.intp]], Floats],
) -> dict[str, float]:
    """Errors of presses that a fit has not seen, for `PhotometricEntry`.

    good : (n,), two presses or more, that are fitted and judged. fit : coefficients (2, 114) from some of
    them. From `ENOUGH_FOR_HALVES` on, each half is judged by the other.
    """
    parts = 2 if len(good) >= ENOUGH_FOR_HALVES else min(FEWEST_PRESSES, len(good))
    errors: list[list[float]] = []
    for part in range(parts):
        judged = np.arange(len(good)) % parts == part
        errors += errors_on(session, samples, good[judged].tolist(), fit(good[~judged]), scale)
    return summary(errors)
