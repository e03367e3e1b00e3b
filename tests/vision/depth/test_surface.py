"""From slopes to heights, in a window around the contact."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tactflow.vision.depth.poisson import integrate
from tactflow.vision.depth.slopes import STEEPEST, SlopeModel, place_terms
from tactflow.vision.depth.surface import LEAST_MARGIN, Rest, Surface, colour_change, surroundings
from tactflow.vision.types import Scale

GEL = np.full((80, 120, 3), (90, 120, 100), np.uint8)
ANY = np.random.default_rng(1).normal(0, 0.3, (6, 19, 2))


def test_heights_are_those_of_the_surface_that_has_the_slopes() -> None:
    y, x = np.mgrid[:40, :60].astype(np.float32)
    surface = 8 * np.exp(-((x - 25) ** 2 + (y - 18) ** 2) / 60)
    slope_y, slope_x = np.gradient(surface)
    found = integrate(slope_x.astype(np.float32), slope_y.astype(np.float32))
    assert np.abs(found - found[0, 0] - (surface - surface[0, 0])).max() < 0.2


@pytest.mark.parametrize("corner", [(0, 0), (70, 100), (0, 50), (33, 41)])
def test_the_window_is_even_and_inside_the_picture_wherever_the_contact_is(corner: tuple[int, int]) -> None:
    mask = np.zeros(GEL.shape[:2], np.uint8)
    mask[corner[0] : corner[0] + 9, corner[1] : corner[1] + 15] = 255
    window, bands = surroundings(mask, Rest(GEL).window)
    assert (window.bottom - window.top) % 2 == (window.right - window.left) % 2 == 0
    assert 0 <= window.top <= corner[0] // 2
    assert window.bottom <= 40
    assert 0 <= window.left <= corner[1] // 2
    assert window.right <= 60
    # All of the contact is in the bands, and they are in the window.
    near = np.zeros(mask.shape, np.bool_)
    for band in bands:
        assert window.top <= band.top < band.bottom <= window.bottom
        assert window.left <= band.left < band.right <= window.right
        near[band.whole] = True
    assert near[:80, :120][mask > 0].all()


def test_of_a_slanting_contact_only_the_gel_beside_it_is_looked_at() -> None:
    mask = np.zeros((400, 400), np.uint8)
    cv2.line(mask, (20, 20), (380, 380), 255, 12)
    window, bands = surroundings(mask, Rest(np.zeros((400, 400, 3), np.uint8)).window)
    pixels = sum((band.bottom - band.top) * (band.right - band.left) for band in bands)
    assert pixels < 0.45 * (window.bottom - window.top) * (window.right - window.left)
    for band in bands[2:-2]:
        middle = (band.top + band.bottom) / 2
        assert abs(middle - (band.left + band.right) / 2) < 5
        assert band.right - band.left >= 2 * LEAST_MARGIN


def test_a_contact_in_the_last_line_that_no_half_resolution_has_is_no_depth() -> None:
    mask = np.zeros((83, 121), np.uint8)
    mask[82, 120] = 255
    gel = np.zeros((83, 121, 3), np.uint8)
    depth = Surface(SlopeModel(ANY), Scale(0.1, 0.1, (0, 0), (0, 0))).depth(gel, Rest(gel), mask)
    assert depth.heights.shape == mask.shape
    assert depth.greatest == 0


def test_no_change_of_colour_is_no_depth_and_neither_is_a_change_of_all_the_light() -> None:
    surface = Surface(SlopeModel(ANY), Scale(0.1, 0.1, (0, 0), (0, 0)))
    mask = np.zeros(GEL.shape[:2], np.uint8)
    mask[30:50, 40:70] = 255
    for image in (GEL, GEL + np.uint8(9)):
        depth = surface.depth(image, Rest(GEL), mask)
        assert depth.greatest == pytest.approx(0, abs=1e-6)
        assert depth.heights.shape == mask.shape
        assert depth.greatest_stderr is None


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_grainy_gel_that_is_not_touched_has_no_change_of_colour_however_its_means_are_rounded(
    dtype: type,
) -> None:
    gel = np.random.default_rng(3).integers(80, 140, GEL.shape).astype(dtype)
    rest = Rest(gel)
    assert np.abs(colour_change(gel, rest, rest.window)).max() == 0


def test_normals_are_the_polynomial_of_colour_and_place_and_never_too_steep() -> None:
    change = np.random.default_rng(2).normal(0, 0.4, (3, 50, 60)).astype(np.float32)
    place = place_terms((60, 50))
    found = SlopeModel(ANY).normals(change, place)
    b, g, r = change[:, 31, 44].astype(float)
    colours = [b, g, r, b * b, b * g, b * r, g * g, g * r, r * r, b * b * b, b * b * g, b * b * r]
    colours += [b * g * g, b * g * r, b * r * r, g * g * g, g * g * r, g * r * r, r * r * r]
    expected = np.einsum("p,c,pcd->d", place[:, 31, 44], colours, ANY)
    expected /= max(1.0, np.hypot(*expected) / STEEPEST)
    assert found[:, 31, 44] == pytest.approx(expected, abs=1e-4)
    assert np.hypot(*found).max() <= STEEPEST + 1e-5


def test_coefficients_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="required finite coefficients"):
        SlopeModel(np.zeros((3, 3, 2)))
