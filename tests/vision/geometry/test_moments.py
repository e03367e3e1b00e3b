"""Moments of a region: whole numbers, equal to those of OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.vision.geometry.moments import Moments, measure_region, region_moments
from tests.oracles.moments import plain_measure_region


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 37), (41, 1), (2, 3), (63, 65), (150, 180), (260, 333)], ids=str
)
def test_box_and_sums_are_those_of_opencv(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(9)
    for _ in range(12):
        mask = np.zeros(size, np.uint8)
        for _ in range(rng.integers(0, 4)):
            center = int(rng.integers(-3, size[1] + 3)), int(rng.integers(-3, size[0] + 3))
            axes = int(rng.integers(0, size[1])), int(rng.integers(0, size[0]))
            value, thick = int(rng.choice([0, 1, 2, 128, 255])), int(rng.choice([-1, 2]))
            cv2.ellipse(mask, center, axes, float(rng.uniform(0, 180)), 0, 360, value, thick)
        mask[rng.random(size) < 0.001] = 7
        found, expected = np.empty(10, np.int64), np.empty(10, np.int64)
        measure_region(mask, found)
        plain_measure_region(mask, expected)
        np.testing.assert_array_equal(found, expected)
        for other in (np.asfortranarray(mask), mask[::1]):
            other.setflags(write=False)
            box, moments = region_moments(other)
            assert [*box, *moments] == expected.tolist()


def test_moved_moments_are_those_of_the_moved_region() -> None:
    y, x = np.array([3, 4, 9]), np.array([1, 7, 2])

    def about(right: int, down: int) -> Moments:
        u, v = x + right, y + down
        sums = (len(u), u.sum(), v.sum(), (u * u).sum(), (u * v).sum(), (v * v).sum())
        return Moments(*(int(value) for value in sums))

    assert about(0, 0).moved(-5, 11) == about(-5, 11)
    assert about(0, 0).central() == about(-5, 11).central()
