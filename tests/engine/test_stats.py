"""Durations: quantiles in constant memory."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from tactflow.engine.stats import Durations


@pytest.mark.parametrize("q", [0.01, 0.5, 0.99, 1.0])
def test_quantiles_are_within_the_width_of_a_bin(q: float) -> None:
    """Bins are exp(1/50) wide and answered by their middle: at most 1.01 % off."""
    values = np.random.default_rng(3).lognormal(-7, 1.5, 5000)
    durations = Durations()
    for value in values:
        durations.add(float(value))
    exact = float(np.quantile(values, q, method="inverted_cdf"))
    assert durations.quantile(q) == pytest.approx(exact, rel=0.0101)
    assert durations.total == pytest.approx(values.sum())


def test_nothing_is_lost_or_counted_twice_while_others_ask() -> None:
    durations = Durations()
    answers: list[int] = []
    done = threading.Event()

    def ask() -> None:
        while not done.is_set():
            answers.append(durations.count)

    asking = [threading.Thread(target=ask) for _ in range(2)]
    for thread in asking:
        thread.start()
    for _ in range(20_000):
        durations.add(2.0**-10)
    done.set()
    for thread in asking:
        thread.join()
    assert durations.count == 20_000
    assert durations.total == 20_000 * 2.0**-10, "sums of powers of two are exact"
    assert durations.quantile(0.0) == durations.quantile(1.0)
    assert max(answers, default=0) <= 20_000


def test_nothing_counted_has_no_quantile() -> None:
    assert Durations().quantile(0.5) is None
    assert Durations().milliseconds(0.5) is None


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-12, 1e9])
def test_values_beyond_the_range_count_in_the_outermost_bin(value: float) -> None:
    durations = Durations()
    durations.add(value)
    assert durations.quantile(0.5) is not None
    assert durations.count == 1
