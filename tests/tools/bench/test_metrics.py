from __future__ import annotations

import numpy as np
import pytest

from tactflow.tools.bench import metrics

SQUARE = np.array([(0, 0), (10, 0), (10, 10), (0, 10)], dtype=np.float64)


def test_detection_counts_a_point_between_two_dots_once() -> None:
    points = np.array([(10.0, 1.0)])
    recall, precision, _ = metrics.detection(points, np.array([(0.0, 0.0), (20.0, 0.0)]), radius=15)
    assert (recall, precision) == (0.5, 1)


@pytest.mark.parametrize(
    ("angle", "truth", "expected"),
    [(89, -89, 2), (-90 + 1e-9, 90, 0), (0, 90, 90), (45, -45, 90), (10, 12, 2)],
)
def test_directions_are_compared_across_the_seam(angle: float, truth: float, expected: float) -> None:
    assert metrics.angle_error(angle, truth) == pytest.approx(expected, abs=1e-6)


def test_the_ratio_of_axes_is_that_of_a_rectangle() -> None:
    mask = np.zeros((100, 100), bool)
    mask[10:20, 10:50] = True
    # The variance of a block of n pixels with their own extent is n^2 / 12: the ratio is exact.
    assert metrics.aspect_ratio(mask) == pytest.approx(4)
    assert metrics.aspect_ratio(np.zeros((5, 5))) == 1


def test_the_area_of_a_hull_on_pixel_centres_is_the_number_of_its_pixels() -> None:
    y, x = np.indices((50, 50))
    for turned in (SQUARE, np.array([(3, 0), (30, 9), (21, 36), (-6, 27)]) + 6):
        edges = np.roll(turned, -1, axis=0) - turned
        sides = [ex * (y - cy) - ey * (x - cx) for (cx, cy), (ex, ey) in zip(turned, edges, strict=True)]
        assert metrics.pixel_area(turned) == np.count_nonzero(np.min(sides, axis=0) >= 0)
