"""Probabilities by logistic regression on labels, and how true they are on labs that were left out."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from tactflow.system.terminal import table
from tactflow.vision.arrays import Flags, Floats

RIDGE: Final = 0.5
"""Ridge penalty: without it, evidence that separates the places of few labs would get infinite weights."""
STEPS: Final = (0, 0.25, 0.5, 0.8, 0.9, 0.95, 0.99, 1)
"""Probabilities between which the truth is counted."""


def fit_probability(evidence: Floats, is_true: Flags) -> Floats:
    """Constant and weights (1 + k,) of the log odds, of evidence (n, k): logistic regression with a ridge."""
    design = np.column_stack([np.ones(len(is_true)), evidence])
    sign = np.where(is_true, -1.0, 1.0)

    def loss(weights: Floats) -> float:
        return float(np.logaddexp(0, sign * (design @ weights)).sum() + RIDGE * (weights[1:] ** 2).sum())

    return np.asarray(minimize(loss, np.zeros(design.shape[1])).x, np.float64)


def fitted(labs: NDArray[np.str_], evidence: Floats, is_true: Flags) -> Iterator[str]:
    """The weights fitted to all labs; and how often what a fit to the others calls so probable is true.

    labs : (n,), of each place. evidence : (n, k). is_true : (n,).
    """
    yield f"constant and weights: {fit_probability(evidence, is_true).round(2).tolist()}"
    odds = np.zeros(len(labs))
    for left_out in np.unique(labs):
        others = labs != left_out
        weights = fit_probability(evidence[others], is_true[others])
        odds[~others] = weights[0] + evidence[~others] @ weights[1:]
    probability = 1 / (1 + np.exp(-odds))
    rows, error = [("called", "places", "are so")], 0.0
    for low, high in pairwise(STEPS):
        those = (probability > low) & (probability <= high)
        share = f"{100 * is_true[those].mean():.1f} %" if those.any() else "-"
        rows.append((f"{100 * low:.0f} to {100 * high:.0f} %", str(those.sum()), share))
        error += abs(float((probability[those] - is_true[those]).sum())) / len(labs)
    yield from table(rows)
    yield f"expected calibration error: {error:.3f}"
