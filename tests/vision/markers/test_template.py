"""Marks against their templates: the kernel does what plain numpy does, everywhere in a picture."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.markers import template as template_module
from tactflow.vision.markers.detection import Detection, detect_markers, to_gray
from tactflow.vision.markers.template import MarkerTemplates, whole_numbers
from tests.oracles import template
from tests.oracles.plain import plain
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


def templates(dark: bool = True) -> MarkerTemplates:
    frame, detection = reference()
    return MarkerTemplates(to_gray(frame).astype(np.float32), detection.centers, detection.dot_radius, dark)


def check_alignment(
    under_test: MarkerTemplates,
    image: NDArray[np.uint8],
    start: FloatArray,
    marks: NDArray[np.int64] | None = None,
    rounding: float = 2e-5,
) -> None:
    found = under_test.align(image, start, marks)
    with plain(template):
        expected = under_test.align(image, start, marks)
    for one, other in zip(found, expected, strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
    # Sums of some hundred products in float32, in another order: relative errors of 1e-6; measured 7e-7 px,
    # 6e-6 for gain and r_squared, 3e-6 px for standard errors.
    np.testing.assert_allclose(found[0], expected[0], atol=5e-6)
    np.testing.assert_allclose(found[1], expected[1], atol=2e-5)
    np.testing.assert_allclose(found[2], expected[2], atol=rounding)
    np.testing.assert_allclose(found[3], expected[3], atol=1e-5, rtol=rounding)


# Where a patch has hardly any contrast beside its light, what the mark leaves unexplained is a difference of
# sums up to 1e6 times as large, whose rounding shows: measured 1.2e-3 of it.
FLAT = 5e-3


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0, 60.0])
def test_marks_are_aligned_alike_wherever_the_search_starts(spread: float, dark: bool) -> None:
    rng = np.random.default_rng(int(10 * spread))
    under_test = templates(dark)
    start = reference()[1].centers + rng.normal(0, 1, (42, 2)) * spread
    image = picture(TRUTH + rng.normal(0, 0.7, TRUTH.shape), seed=3)
    rounding = FLAT if spread > 10 else 2e-5
    check_alignment(under_test, image, start, rounding=rounding)
    check_alignment(under_test, to_gray(image), start, rounding=rounding)
    some = np.array([5, 41, 0, 17])
    check_alignment(under_test, image, start[some], some, rounding=rounding)


def test_marks_are_aligned_alike_at_and_beyond_the_border() -> None:
    width, height = SIZE
    places = np.array(
        [
            [x, y]
            for x in (-500.0, -0.4, 0.0, 0.6, width - 8.0, width - 6.0, width - 4.0, width + 300.0)
            for y in (-9.0, 2.5, 70.0, height - 5.0, 1e7)
        ]
    )
    marks = np.arange(len(places))
    image = np.random.default_rng(1).integers(0, 256, (height, width, 3)).astype(np.uint8)
    check_alignment(templates(), image, places, marks)
    check_alignment(templates(), to_gray(image), places, marks)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (3, 2)])
def test_marks_are_aligned_alike_in_pictures_smaller_than_a_patch(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(size))
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    origin = rng.uniform(0, max(size), (3, 2))
    under_test = MarkerTemplates(to_gray(image).astype(np.float32), origin, 2.0)
    check_alignment(under_test, image, origin, rounding=FLAT)


def test_a_starting_point_that_is_no_number_reads_inside_the_picture() -> None:
    frame, detection = reference()
    under_test = templates()
    start = detection.centers.copy()
    start[3] = np.nan
    found = under_test.align(frame, start)
    assert all(np.isfinite(part).all() for part in found)


def test_grey_is_that_of_opencv_to_the_last_level() -> None:
    # All colours whose weighted sum lies at a rounding boundary of the fixed-point luma.
    blue, green, red = np.meshgrid(*[np.arange(256)] * 3, indexing="ij")
    close = (3735 * blue + 19235 * green + 9798 * red + 16384 + 24) % 32768 < 48
    colours = np.stack([blue[close], green[close], red[close]], axis=1).astype(np.uint8)
    width, height = SIZE
    assert len(colours) > width * height / 2
    under_test, start = templates(), reference()[1].centers
    for seed in range(3):
        image = np.random.default_rng(seed).permutation(np.resize(colours, (width * height, 3)))
        image = image.reshape(height, width, 3)
        coloured = under_test.align(image, start)
        grey = under_test.align(to_gray(image), start)
        for one, other in zip(coloured, grey, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("dark", [True, False])
def test_templates_of_whole_numbers_find_marks_as_templates_of_float64_do(
    dark: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights: list[FloatArray] = []

    def recorded(exact: FloatArray) -> tuple[NDArray[np.int16], FloatArray]:
        weights.append(exact)
        return whole_numbers(exact)

    monkeypatch.setattr(template_module, "whole_numbers", recorded)
    under_test = templates(dark)
    image = picture(TRUTH + 0.2, seed=3)
    start = TRUTH + np.random.default_rng(4).uniform(-1, 1, TRUTH.shape)
    found = under_test.align(image, start)
    exact = np.zeros(under_test._weights.shape)
    exact[:, :, : weights[0].shape[2]] = np.concatenate(weights)
    monkeypatch.setattr(under_test, "_weights", exact)
    under_test._terms[:, 10:15] = 1
    with plain(template):
        expected = under_test.align(image, start)
    # Measured: 6e-6 px, 2e-6 for gain, 4e-6 for r_squared, 1.2e-5 px for standard errors.
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-5)


def test_the_largest_marks_are_told_from_a_picture_without_them() -> None:
    """The sum of the squares of such a patch takes more than 32 bits."""
    radius, middle = 140.0, np.array([[260.0, 260.0]])
    y, x = np.mgrid[:520, :520] - 260
    mark = (5 + 245 * np.clip(np.hypot(x, y) - radius + 0.5, 0, 1)).astype(np.uint8)
    under_test = MarkerTemplates(mark.astype(np.float32), middle, radius)
    stripes = np.where((x // 40 + y // 40) % 2, 5, 250).astype(np.uint8)
    for image, least, most in ((mark, 0.999, 1.0), (stripes, 0.0, 0.2)):
        found = under_test.align(image, middle)
        assert least <= found.r_squared[0] <= most
        check_alignment(under_test, image, middle)
