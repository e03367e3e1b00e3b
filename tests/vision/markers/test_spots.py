"""Spots: peaks of the response."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.markers.scale_space import find_peaks


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 3), (5, 40), (41, 37)])
def test_peaks_are_the_pixels_that_nothing_around_exceeds(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[1])
    for response in (np.ones(shape), rng.normal(0, 1, shape), rng.integers(0, 3, shape)):
        values = response.astype(np.float32)
        for least in (-1.0, 0.0, 0.7):
            points, height = find_peaks(values, least, reach=2)
            expected = [
                (x, y)
                for y in range(1, shape[0] - 1)
                for x in range(1, shape[1] - 1)
                if values[y, x] > least
                and values[y, x] == values[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].max()
            ]
            assert len(points) == len(expected)
            if expected:
                assert np.abs(points - expected).max() <= 0.5
                np.testing.assert_array_equal(height, [values[y, x] for x, y in expected])


def test_a_peak_is_at_the_vertex_of_its_parabolas() -> None:
    y, x = np.mgrid[:9, :12]
    points, _ = find_peaks((50 - (x - 6.3) ** 2 - (y - 3.8) ** 2).astype(np.float32), 0.0, reach=2)
    np.testing.assert_allclose(points, [[6.3, 3.8]], atol=1e-5)
