"""Shape of a mask's regions: whole numbers, equal to those of OpenCV."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.geometry.moments import RegionProperties, measure_region, wrap_rows
from tests.oracles.moments import plain_measure_region, plain_wrap_rows

SIZES = [(1, 1), (1, 37), (41, 1), (2, 3), (63, 65), (150, 180), (260, 333)]


def masks(size: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
    """Some of one region, some of several, some with holes and specks, some empty."""
    rng = np.random.default_rng(9)
    for number in range(16):
        mask = np.zeros(size, np.uint8)
        for _ in range(rng.integers(0, 4)):
            center = int(rng.integers(-3, size[1] + 3)), int(rng.integers(-3, size[0] + 3))
            axes = int(rng.integers(0, size[1])), int(rng.integers(0, size[0]))
            value, thick = int(rng.choice([0, 1, 2, 128, 255])), int(rng.choice([-1, 2]))
            cv2.ellipse(mask, center, axes, float(rng.uniform(0, 180)), 0, 360, value, thick)
        if number % 2:
            mask[rng.random(size) < 0.001] = 7
        yield mask


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_box_sums_and_ends_of_rows_are_those_of_opencv(size: tuple[int, int]) -> None:
    for mask in masks(size):
        ends, expected_ends = np.empty((2, size[0], 2), np.int32)
        expected = plain_measure_region(mask, expected_ends)
        assert measure_region(mask, ends) == expected
        np.testing.assert_array_equal(ends, expected_ends)
        for other in (np.asfortranarray(mask), mask[::1]):
            other.setflags(write=False)
            region = RegionProperties(other)
            assert [*region.box, *region.moments, region.connected] == [*expected]


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_the_hull_of_rows_is_that_of_opencv_and_so_are_contours(size: tuple[int, int]) -> None:
    for mask in masks(size):
        region = RegionProperties(mask, (5, -3))
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(5, -3))
        assert [part.tolist() for part in region.contours] == [part.tolist() for part in contours]
        if not contours:
            continue
        polygon, pixels = region.hull()
        hull = cv2.convexHull(np.concatenate(contours))[:, 0].tolist()
        start = hull.index(polygon[0].tolist())
        assert polygon.tolist() == hull[start:] + hull[:start]
        ends = np.empty((size[0], 2), np.int32)
        measure_region(mask, ends)
        corners, expected = np.empty((2, 2 * size[0] + 2, 2))
        count, _ = wrap_rows(ends, 5, -3, corners)
        assert (count, pixels) == plain_wrap_rows(ends, 5, -3, expected)
        np.testing.assert_array_equal(corners[:count], expected[:count])
