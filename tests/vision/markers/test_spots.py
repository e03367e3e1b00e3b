"""Spots: peaks of the response, and which points lie near which."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.markers.spots import CELL, NearPoints, find_peaks


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


def test_points_are_near_others_within_a_disc_to_the_width_of_a_cell() -> None:
    rng = np.random.default_rng(9)
    pitch, both = 24.0, 0
    under_test = NearPoints((150, 170), pitch)
    for _ in range(100):
        points, others = (rng.uniform((0, 0), (170, 150), (rng.integers(1, 40), 2)) for _ in range(2))
        distance = float(rng.uniform(0.3, 1.2))
        found = under_test.near(points, others, under_test.disc(distance))
        away = np.linalg.norm(points[:, None] - others, axis=2).min(axis=1) / pitch
        # Two roundings to cells and that of the disc.
        assert found[away < distance - 2 * CELL].all()
        assert not found[away > distance + 2 * CELL].any()
        both += int(found.any() and not found.all())
    assert both > 30


def test_a_point_beyond_the_frame_counts_to_its_border() -> None:
    near = NearPoints((150, 170), 24.0)
    found = near.near(np.array([[-40.0, 60.0]]), np.array([[0.0, 60.0]]), near.disc(0.3))
    assert found.tolist() == [True]
