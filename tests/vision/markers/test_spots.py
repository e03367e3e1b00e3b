"""Spots: peaks of the response, and which points lie near which."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.vision.markers.spots import NearPoints, find_peaks
from tests.oracles import spots
from tests.oracles.plain import plain


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 3), (5, 40), (41, 37)])
def test_peaks_are_the_same_pixels_and_vertices(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[1])
    pictures = [
        np.zeros(shape, np.float32),
        np.ones(shape, np.float32),
        rng.normal(0, 1, shape).astype(np.float32),
        rng.integers(0, 3, shape).astype(np.float32),
        np.asarray(cv2.GaussianBlur(rng.normal(0, 9, shape).astype(np.float32), (0, 0), 1.5), np.float32),
    ]
    for response in pictures:
        for least in (-1.0, 0.0, 0.7):
            found = find_peaks(response, least, reach=2)
            with plain(spots):
                expected = find_peaks(response, least, reach=2)
            # Single operations in the same precision and order: the same bits.
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one, other)


def test_more_peaks_than_there_is_room_for_are_found_too() -> None:
    # On a plateau every pixel is as high as all around it.
    points, _ = find_peaks(np.ones((60, 50), np.float32), 0.5, reach=2)
    assert len(points) == 58 * 48


def test_nearness_is_the_same() -> None:
    rng = np.random.default_rng(9)
    under_test = NearPoints((150, 170), 24.0)
    both = 0
    for _ in range(300):
        points, others = (rng.uniform(-40, 200, (rng.integers(0, 40), 2)) for _ in range(2))
        disc = under_test.disc(float(rng.uniform(0.1, 1.2)))
        found = under_test.near(points, others, disc)
        with plain(spots):
            np.testing.assert_array_equal(found, under_test.near(points, others, disc))
        both += int(found.any() and not found.all())
    assert both > 100
