"""Fit the force to the displacement field of the dots, by ridge regression.

The penalty of each component is the one that predicts loads best that are left out of the fit, and the stated
errors are those of these predictions.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats
from tactflow.vision.field_force import FieldForce, polynomial_terms

MAX_MODES: Final = 24
"""Modes of the displacement field at most; they have 324 polynomial terms. Real gels show about ten above the
noise of dots. Up to as many loads the modes are complete, so that choosing them favours no load."""
MAX_FRAMES: Final = 2000
"""Frames that are used at most; of more, every second, third and so on: frames of a press resemble each
other."""
PENALTIES: Final = np.logspace(-5, 0, 21)
"""Candidates for the penalty, relative to the mean square of the terms: from a fit to noise to one that keeps
only the largest mode."""
RATIOS: Final = np.concatenate([[0.0], np.logspace(-3, 1, 41)])
"""Candidates for the ratio of the relative to the absolute part of the standard error, per N."""


class FieldFit(NamedTuple):
    """model : with NaN for components that are not known. kept : (m,) int, the frames that were used.
    predicted : (m, 3) float64, N, of each of them by a fit to the other groups."""

    model: FieldForce
    kept: NDArray[np.intp]
    predicted: Floats


def fit_field(moved: Floats, force: Floats, groups: NDArray[np.intp]) -> FieldFit:
    """Fit the force to displacement fields.

    moved : (n, S, 2) float64, mm. force : (n, 3) float64, N; a column of NaN for a component that was not
    measured. groups : (n,) int, of frames that are left out together; three or more.

    >>> rng = np.random.default_rng(1)
    >>> moved = np.repeat(rng.normal(size=(12, 1, 2)), 4, axis=0)
    >>> force = np.column_stack([2 * moved[:, 0, 0], np.full(48, np.nan), moved[:, 0, 1]])
    >>> fit = fit_field(moved, force, np.repeat(np.arange(12), 4))
    >>> fit.model(np.array([[0.5, 1.0]])).round(1).tolist()
    [1.0, nan, 1.0]
    """
    kept = np.arange(0, len(moved), math.ceil(len(moved) / MAX_FRAMES))
    numbers = np.unique(groups[kept], return_inverse=True)[1]
    fields = moved.reshape(len(moved), -1)
    values, vectors = np.linalg.eigh(fields[kept].T @ fields[kept] / len(kept))
    modes = vectors[:, ::-1].T[:MAX_MODES] / math.sqrt(max(float(values.sum()), 1e-30))
    terms = polynomial_terms(fields[kept] @ modes.T)
    known = np.isfinite(force).all(axis=0)
    weights, predicted = np.full((terms.shape[1], 3), np.nan), np.full((len(kept), 3), np.nan)
    weights[:, known], predicted[:, known] = _ridge(terms, force[kept][:, known], numbers)
    return FieldFit(FieldForce(modes, weights), kept, predicted)


def _ridge(terms: Floats, force: Floats, groups: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Weights (m, c) of the terms (n, m) in c components (n, c), and predictions (n, c) of groups left out.

    The penalty with which a group is predicted is chosen by the others alone (nested cross-validation).
    """
    penalties = PENALTIES * float(np.square(terms).sum())
    residuals = _left_out(terms, force, groups, penalties)
    component = np.arange(force.shape[1])
    best = np.argmin(np.square(residuals).sum(axis=1), axis=0)
    values, vectors = np.linalg.eigh(terms.T @ terms)
    shrunk = (vectors.T @ (terms.T @ force)) / (np.maximum(values, 0)[:, None] + penalties[best])
    predicted = np.empty_like(force)
    for group in range(groups.max() + 1):
        held = groups == group
        others = _left_out(terms[~held], force[~held], groups[~held], penalties)
        best = np.argmin(np.square(others).sum(axis=1), axis=0)
        predicted[held] = force[held] - residuals[best][:, held][component, :, component].T
    return vectors @ shrunk, predicted


def _left_out(terms: Floats, force: Floats, groups: NDArray[np.intp], penalties: Floats) -> Floats:
    """(p, n, c): residuals of ridge regressions with p penalties, each group predicted by the others.

    Those of a group are (1 - H)^-1 times the residuals of the fit to all, with H its block of the hat matrix.
    """
    values, vectors = np.linalg.eigh(terms.T @ terms)
    turned, product = terms @ vectors, vectors.T @ (terms.T @ force)
    shrink = 1 / (np.maximum(values, 0) + penalties[:, None])
    residuals = force - turned @ (shrink[:, :, None] * product)
    for group in np.unique(groups):
        held = groups == group
        hat = (turned[held] * shrink[:, None]) @ turned[held].T
        residuals[:, held] = np.linalg.solve(np.eye(hat.shape[1]) - hat, residuals[:, held])
    return np.asarray(residuals)


def error_parts(residual: Floats, force: Floats) -> tuple[float, float]:
    """Maximum likelihood estimate of the absolute and the relative part of the standard error.

    residual, force : (n,), N.

    >>> force = np.tile([1.0, 10.0], 500)
    >>> absolute, relative = error_parts(force * np.random.default_rng(1).normal(0, 0.1, 1000), force)
    >>> absolute < 0.02, round(relative, 1)
    (True, 0.1)
    """
    forms = 1 + (RATIOS[:, None] * force) ** 2
    variances = np.maximum(np.mean(residual**2 / forms, axis=1), 1e-30)
    best = int(np.argmin(len(residual) * np.log(variances) + np.log(forms).sum(axis=1)))
    absolute = math.sqrt(variances[best])
    return absolute, float(RATIOS[best]) * absolute
