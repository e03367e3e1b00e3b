"""Similarities that are known, and what is left where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.geometry.similarity import as_complex, fit_similarity

GENERATOR = np.random.default_rng(0)
PLACES = as_complex(GENERATOR.uniform(-50, 50, (30, 2)))
WEIGHTS = GENERATOR.dirichlet(np.ones(30))


def test_shift_turn_and_growth_are_recovered_whatever_the_weights() -> None:
    fit = fit_similarity(PLACES, (3 - 2j) + (0.1 + 0.05j) * PLACES, WEIGHTS)
    assert fit.slope == pytest.approx(0.1 + 0.05j)
    assert fit.mean - fit.slope * fit.middle == pytest.approx(3 - 2j)


def test_places_without_weight_do_not_count() -> None:
    vectors, weights = 0.2j * PLACES, WEIGHTS.copy()
    vectors[:5], weights[:5] = 100, 0
    assert fit_similarity(PLACES, vectors, weights / weights.sum()).slope == pytest.approx(0.2j)


def test_a_single_place_has_a_mean_and_no_slope() -> None:
    fit = fit_similarity(np.array([4 + 1j]), np.array([2j]), np.ones(1))
    assert (fit.mean, fit.slope, fit.spread) == (2j, 0, 0)
