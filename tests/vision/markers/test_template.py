"""Marks against their templates: where they are, everywhere in a picture."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.markers.detection import Detection, detect_markers, to_gray
from tactflow.vision.markers.template import MarkerTemplates
from tests.vision.dots import FloatArray, grid, render

SIZE = (150, 170)
PITCH = 24.0
TRUTH = grid(7, 6, PITCH, corner=(14.3, 13.8), jitter=0.4)


def picture(centers: FloatArray, seed: int = 0) -> NDArray[np.uint8]:
    return render(SIZE, centers, 3.4, noise=1.0, seed=seed)


@cache
def reference() -> tuple[NDArray[np.uint8], Detection]:
    frame = picture(TRUTH, seed=99)
    return frame, detect_markers(frame)


def templates() -> MarkerTemplates:
    frame, detection = reference()
    return MarkerTemplates(
        to_gray(frame).astype(np.float32),
        detection.centers,
        np.full(len(detection.centers), detection.dot_radius),
    )


@pytest.mark.parametrize("spread", [0.0, 0.5, 1.0])
def test_marks_are_found_wherever_within_a_radius_the_search_starts(spread: float) -> None:
    rng = np.random.default_rng(int(10 * spread))
    moved = rng.normal(0, 0.7, TRUTH.shape)
    start = TRUTH + np.clip(rng.normal(0, spread, TRUTH.shape), -2.5, 2.5)
    image = picture(TRUTH + moved, seed=3)
    found = templates().align(image, start)
    off = found.position - reference()[1].centers - moved
    # Of both pictures' noise; the stated error is that of one of them.
    assert np.abs(off - np.median(off, axis=0)).max() < 0.15
    assert np.sqrt(np.mean(off**2)) < 3 * np.sqrt(np.mean(found.stderr**2))
    gray = templates().align(to_gray(image), start)
    np.testing.assert_allclose(found.position, gray.position, atol=1e-6)
    some = np.array([5, 41, 0, 17])
    np.testing.assert_array_equal(templates().align(image, start[some], some).position, found.position[some])


def test_in_a_picture_that_does_not_change_marks_stay_where_they_are() -> None:
    """Small marks near the middle between two phases, where either template may lead to the other."""
    origin = grid(7, 6, PITCH, corner=(14.2, 14.1))
    first = render(SIZE, origin, 2.2)[:, :, 0].astype(np.float32)
    model = MarkerTemplates(first, origin, np.full(len(origin), 2.2))
    image = render(SIZE, np.add(origin, (0.3, 0.4)), 2.2, noise=6.0, seed=1)
    found = [model.align(image, np.add(origin, (0.3, 0.4))).position]
    for _ in range(4):
        found.append(model.align(image, found[-1]).position)
    np.testing.assert_array_equal(found[-1], found[-2])


def test_grey_is_that_of_opencv() -> None:
    image = np.random.default_rng(4).integers(0, 256, (*SIZE[::-1], 3)).astype(np.uint8)
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    for one, other in zip(templates().align(image, TRUTH), templates().align(gray, TRUTH), strict=True):
        np.testing.assert_array_equal(one, other)


def test_starting_points_at_and_beyond_the_border_and_no_numbers_read_inside_the_picture() -> None:
    width, height = SIZE
    places = [[x, y] for x in (-500.0, -0.4, width - 4.0, width + 300.0, np.nan) for y in (-9.0, 70.0, 1e7)]
    image = np.random.default_rng(1).integers(0, 256, (height, width, 3)).astype(np.uint8)
    found = templates().align(image, np.array(places), np.arange(len(places)))
    assert all(np.isfinite(part).all() for part in found)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (3, 2)])
def test_pictures_smaller_than_a_patch_are_read(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(size))
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    origin = rng.uniform(0, max(size), (3, 2))
    found = MarkerTemplates(to_gray(image).astype(np.float32), origin, np.full(3, 2.0)).align(image, origin)
    assert all(np.isfinite(part).all() for part in found)


def test_the_largest_marks_are_told_from_a_picture_without_them() -> None:
    radius, middle = 140.0, np.array([[260.0, 260.0]])
    y, x = np.mgrid[:520, :520] - 260
    mark = (5 + 245 * np.clip(np.hypot(x, y) - radius + 0.5, 0, 1)).astype(np.uint8)
    under_test = MarkerTemplates(mark.astype(np.float32), middle, np.array([radius]))
    stripes = np.where((x // 40 + y // 40) % 2, 5, 250).astype(np.uint8)
    found = under_test.align(mark, middle)
    assert found.seen.all()
    # All of it is explained: only what sampling leaves.
    assert found.stderr[0] < 0.005
    assert not under_test.align(stripes, middle).seen.any()
