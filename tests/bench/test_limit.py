from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.bench import limit

_erf = np.frompyfunc(math.erf, 1, 1)


def soft_disc(
    shape: tuple[int, int], center: tuple[float, float], radius: float, edge: float
) -> NDArray[np.float64]:
    """The disc that the limit is about. shape : (height, width), px. center : (x, y), px."""
    y, x = np.indices(shape, dtype=np.float64)
    r = np.hypot(x - center[0], y - center[1])
    return np.asarray(0.5 * (1 + _erf((radius - r) / (edge * math.sqrt(2)))), dtype=np.float64)


def test_the_information_of_a_large_disc_is_that_of_the_closed_form() -> None:
    # J = pi R / (2 sqrt(pi) b) for R >> b; at R = 20 b the next term is of order (b / R)^2 = 0.25 %.
    assert limit.disc_information(10, 0.5) == pytest.approx(
        math.pi * 10 / (2 * math.sqrt(math.pi) * 0.5), rel=5e-3
    )


def test_the_bound_falls_with_contrast_and_channels() -> None:
    one = limit.position_bound(4, 0.8, 80, 2)
    assert limit.position_bound(4, 0.8, 160, 2) == pytest.approx(one / 2)
    assert limit.position_bound(4, 0.8, [80, 80, 80], 2) == pytest.approx(one / math.sqrt(3))


def test_a_reference_of_one_frame_doubles_the_variance() -> None:
    assert limit.displacement_bound(0.01, 1) == pytest.approx(0.02)
    assert limit.displacement_bound(0.01, 10**9) == pytest.approx(0.01 * math.sqrt(2))


@pytest.mark.parametrize("arguments", [(0, 1, 80, 2), (4, 0, 80, 2), (4, 1, 0, 2), (4, 1, 80, 0)])
def test_a_dot_that_cannot_be_seen_has_no_bound(arguments: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="required"):
        limit.position_bound(*arguments)


def test_maximum_likelihood_reaches_the_bound_and_does_not_beat_it() -> None:
    radius, edge, contrast, noise = 3.5, 0.8, 60.0, 3.0
    shape, center = (21, 21), (10.2, 9.7)
    random = np.random.default_rng(5)
    clean = soft_disc(shape, center, radius, edge)
    step = 1e-3
    gradient = np.stack(
        [
            (
                soft_disc(shape, (center[0] + step * i, center[1] + step * j), radius, edge)
                - soft_disc(shape, (center[0] - step * i, center[1] - step * j), radius, edge)
            )
            / (2 * step)
            for i, j in ((1, 0), (0, 1))
        ]
    ).reshape(2, -1)
    errors = []
    for _ in range(1500):
        image = 120 - contrast * clean + random.normal(0, noise, shape)
        # Gauss-Newton step of the likelihood at the truth: its maximum to first order in the (small) error.
        # Brightness, contrast and centre are all unknown to the estimator.
        design = np.column_stack(
            [-contrast * gradient[0], -contrast * gradient[1], clean.ravel(), np.ones(clean.size)]
        )
        residual = (image - (120 - contrast * clean)).ravel()
        solution = np.linalg.lstsq(design, residual, rcond=None)[0]
        errors.append(solution[:2])
    measured = float(np.std(errors))
    bound = limit.position_bound(radius, edge, contrast, noise)
    # 3000 coordinates: the standard deviation is known to 1 / sqrt(6000) = 1.3 %; four times that allowed.
    assert measured == pytest.approx(bound, rel=0.052)


def test_rounding_adds_a_twelfth() -> None:
    random = np.random.default_rng(1)
    values = random.normal(100.3, 1.0, 200_000)
    # The standard deviation of 2e5 samples is known to 0.16 %.
    assert np.std(np.round(values)) == pytest.approx(limit.rounded(1.0), rel=0.007)
