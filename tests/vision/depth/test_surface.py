"""From slopes to heights, in a window around the contact."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.depth.poisson import ALL_OPEN, Sides, integrate
from tactflow.vision.depth.slopes import BAND_ROWS, MAX_HORIZONTAL_PART, SlopeModel, coordinates, place_terms
from tactflow.vision.depth.surface import Rest, Surface, SurfaceErrors, colour_change, half_resolution
from tactflow.vision.depth.surroundings import resting, surroundings
from tactflow.vision.types import Scale

GEL = np.full((80, 120, 3), (90, 120, 100), np.uint8)
ANY = np.random.default_rng(1).normal(0, 0.3, (6, 19, 2))


def test_heights_are_those_of_the_surface_that_has_the_slopes() -> None:
    y, x = np.mgrid[:40, :60].astype(np.float32)
    surface = 8 * np.exp(-((x - 25) ** 2 + (y - 18) ** 2) / 60)
    slope_y, slope_x = np.gradient(surface)
    slope = np.stack([slope_x, slope_y]).astype(np.float32)
    assert np.abs(integrate(slope, (1, 1)) - surface).max() < 0.2
    open_sides = integrate(slope, (1, 1), ALL_OPEN)
    assert np.abs(open_sides - open_sides[0, 0] - (surface - surface[0, 0])).max() < 0.2


@pytest.mark.parametrize(
    ("part", "sides"),
    [
        (np.s_[:, 40:], ((True, False), (False, False))),
        (np.s_[:, :40], ((False, True), (False, False))),
        (np.s_[40:, :], ((False, False), (True, False))),
        (np.s_[:40, :], ((False, False), (False, True))),
    ],
    ids=["left", "right", "top", "bottom"],
)
def test_a_surface_that_one_side_of_the_window_cuts_off_is_at_rest_at_the_others(
    part: tuple[slice, slice], sides: Sides
) -> None:
    y, x = np.mgrid[:80, :80].astype(np.float32)
    surface = 8 * np.exp(-((x - 40) ** 2 + (y - 40) ** 2) / 90)
    slope = np.stack(np.gradient(surface)[::-1]).astype(np.float32)
    found = integrate(slope[(slice(None), *part)], (1, 1), sides)
    assert np.abs(found - surface[part]).max() < 0.25


@pytest.mark.parametrize("size", [(40, 61), (37, 60), (2, 8)])
def test_sides_of_any_length_are_integrated(size: tuple[int, int]) -> None:
    down, across = np.random.default_rng(4).normal(0, 1, (2, *size))
    surface = np.cumsum(down, axis=0) + np.cumsum(across, axis=1)
    # Slopes whose means of two neighbours are the differences of the surface.
    slope = np.zeros((2, *size))
    for column in range(1, size[1]):
        slope[0, :, column] = 2 * np.diff(surface, axis=1)[:, column - 1] - slope[0, :, column - 1]
    for row in range(1, size[0]):
        slope[1, row] = 2 * np.diff(surface, axis=0)[row - 1] - slope[1, row - 1]
    found = integrate(slope.astype(np.float32), (1, 1), ALL_OPEN)
    assert found - found[0, 0] == pytest.approx(surface - surface[0, 0], abs=1e-2)


@pytest.mark.parametrize("corner", [(0, 0), (70, 100), (0, 50), (33, 41)])
def test_the_window_is_inside_the_picture_and_the_contact_in_the_window(corner: tuple[int, int]) -> None:
    mask = np.zeros(GEL.shape[:2], np.uint8)
    mask[corner[0] : corner[0] + 9, corner[1] : corner[1] + 15] = 255
    window, near = surroundings(mask, Rest(GEL).window)
    assert 0 <= window.top <= corner[0] // 2
    assert window.bottom <= 40
    assert 0 <= window.left <= corner[1] // 2
    assert window.right <= 60
    rows = near.repeat(BAND_ROWS, axis=0)[: window.height]
    assert rows.shape == (window.height, window.width)
    assert (rows[mask[window.whole][::2, ::2] > 0] > 0).all()


@pytest.mark.parametrize("reach", [40, 80, 140])
def test_the_gel_is_at_rest_where_its_light_has_faded_and_a_change_of_all_the_light_does_not_count(
    reach: int,
) -> None:
    y, x = np.mgrid[:48, :64] * 8 + 4
    mask = np.where(np.hypot(x - 250, y - 200) < 40, 255, 0).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    faded = np.clip(1 - (np.hypot(x - 250, y - 200) - 40) / reach, 0, 1)
    gain = np.array([0.7, 1.2, 1.3], np.float32)
    # A gel that is darker to the right: exposure changes bright places by more.
    level = np.broadcast_to((0.9 - 0.3 * x / 512)[..., None], (*x.shape, 3)).astype(np.float32)
    change = faded[..., None] * np.array([0.3, -0.2, 0.1]) + (gain - 1) * level
    pressed = mask[::8, ::8].repeat(8, 0).repeat(8, 1)[:384, :512]
    found = resting(change.astype(np.float32), level, pressed)
    assert abs(2 * found.margin - reach) <= 12
    assert found.gain == pytest.approx(gain, abs=1e-4)


def pressed() -> tuple[SlopeModel, np.ndarray, np.ndarray, np.ndarray]:
    """A model, a gel, a round press of it, and its mask. About 0.5 mm deep at 0.1 mm a pixel."""
    y, x = np.mgrid[:160, :200]
    model = np.zeros((6, 19, 2))
    # The first two channels are the two parts of the normal.
    model[0, 0, 0] = model[0, 1, 1] = 1
    inward = np.exp(-((x - 100.0) ** 2 + (y - 80.0) ** 2) / 400)
    gel = np.full((160, 200, 3), 100, np.uint8)
    change = np.stack([inward * (x - 100), inward * (y - 80), 0 * x], axis=2) / 40
    image = np.rint(gel + 120 * change).astype(np.uint8)
    mask = np.where(np.hypot(x - 100, y - 80) < 20, 255, 0).astype(np.uint8)
    return SlopeModel(model), gel, image, mask


@pytest.mark.parametrize("gain", [(0.68, 0.66, 0.95), (1.2, 1.1, 1.15)])
def test_a_change_of_exposure_and_white_balance_leaves_the_slopes_as_they_are(
    gain: tuple[float, float, float],
) -> None:
    model, gel, image, mask = pressed()
    # A gel that is darker to the right.
    fall = np.linspace(1, 0.5, 200)[None, :, None]
    gel, image = (np.rint(part * fall).astype(np.uint8) for part in (gel, image))
    surface = Surface(model, Scale(0.1, 0.1, (0, 0), (0, 0)))
    expected = surface.depth(image, Rest(gel), mask)
    found = surface.depth(np.rint(image * gain).astype(np.uint8), Rest(gel), mask)
    assert np.abs(found.heights - expected.heights).max() < 0.05 * expected.greatest


@pytest.mark.parametrize(
    ("thickness", "scale", "most"), [(0.2, 0.1, 0.2), (4.0, 0.1, None), (0.04, 0.01, 0.04)]
)
def test_no_depth_exceeds_the_gel_and_the_stated_error_contains_the_difference(
    thickness: float, scale: float, most: float | None
) -> None:
    model, gel, image, mask = pressed()
    mm = Scale(scale, scale, (0, 0), (0, 0))
    errors = SurfaceErrors(0.9)
    free = Surface(model, mm, errors).depth(image, Rest(gel), mask)
    found = Surface(model, mm, errors, thickness).depth(image, Rest(gel), mask)
    if most is None:
        assert found.greatest == free.greatest
        assert found.greatest_stderr == free.greatest_stderr
        return
    assert found.greatest == most
    assert found.heights.max() == pytest.approx(most, rel=0.01)
    assert found.greatest_stderr >= free.greatest - most
    assert found.volume == pytest.approx(free.volume * most / free.greatest, rel=1e-4)


def test_a_press_has_no_step_along_the_border_of_its_heights() -> None:
    model, gel, image, mask = pressed()
    depth = Surface(model, Scale(0.1, 0.1, (0, 0), (0, 0))).depth(image, Rest(gel), mask)
    rows, columns = (np.flatnonzero(depth.heights.any(axis=axis)) for axis in (1, 0))
    around = [depth.heights[rows[[0, -1]]].max(), depth.heights[:, columns[[0, -1]]].max()]
    assert max(around) < 0.01 * depth.greatest
    assert depth.greatest == pytest.approx(0.1 * 200 / 40, rel=0.15)


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
    assert np.abs(colour_change(half_resolution(gel), rest, rest.window, np.ones(3, np.float32))).max() == 0


def test_slopes_are_those_of_normals_that_are_a_polynomial_of_colour_and_place_and_never_too_steep() -> None:
    change = np.random.default_rng(2).normal(0, 0.4, (50, 60, 3)).astype(np.float32)
    found = SlopeModel(ANY).slopes(change, *coordinates((60, 50)), np.ones((7, 60), np.uint8))
    b, g, r = change[31, 44].astype(float)
    colours = [b, g, r, b * b, b * g, b * r, g * g, g * r, r * r, b * b * b, b * b * g, b * b * r]
    colours += [b * g * g, b * g * r, b * r * r, g * g * g, g * g * r, g * r * r, r * r * r]
    expected = np.einsum("p,c,pcd->d", place_terms((60, 50))[:, 31, 44], colours, ANY)
    expected /= max(1.0, np.hypot(*expected) / MAX_HORIZONTAL_PART)
    assert found[:, 31, 44] == pytest.approx(expected / np.sqrt(1 - (expected**2).sum()), abs=1e-3)
    assert np.hypot(*found).max() <= MAX_HORIZONTAL_PART / np.sqrt(1 - MAX_HORIZONTAL_PART**2) + 1e-4


def test_beyond_the_steepest_normal_of_the_balls_normals_are_in_proportion_to_the_colour() -> None:
    steepest = 0.4
    change = np.random.default_rng(2).normal(0, 0.3, (40, 60, 3)).astype(np.float32)
    everywhere = np.ones((5, 60), np.uint8)

    def normals(model: SlopeModel, change: np.ndarray, steepest: float) -> np.ndarray:
        slope = model.slopes(change.astype(np.float32), *coordinates((60, 40)), everywhere, steepest)
        return np.asarray(slope / np.sqrt(1 + (slope**2).sum(axis=0)))

    whole = normals(SlopeModel(ANY), change, MAX_HORIZONTAL_PART)
    found = normals(SlopeModel(ANY), change, steepest)
    length = np.hypot(*found)
    beyond = (length > 1.01 * steepest) & (length < 0.99 * MAX_HORIZONTAL_PART)
    assert np.allclose(found[:, length < steepest], whole[:, length < steepest], atol=1e-4)
    assert beyond.mean() > 0.1
    part = steepest / np.maximum(length, steepest)
    there = normals(SlopeModel(ANY), change * part[..., None], MAX_HORIZONTAL_PART)
    assert np.abs(there - found * part)[:, beyond].max() < 2e-3
    linear = ANY.copy()
    linear[:, 3:] = 0
    for limit in (steepest, MAX_HORIZONTAL_PART):
        same = normals(SlopeModel(linear), change, limit)
        assert np.allclose(same, normals(SlopeModel(linear), change, MAX_HORIZONTAL_PART), atol=1e-3)


def test_coefficients_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match="required finite coefficients"):
        SlopeModel(np.zeros((3, 3, 2)))
