"""The shape of a gel from how its light has changed, and the contacts that it shows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from tactflow.vision.contact.heights import HeightModel, Heights
from tactflow.vision.contact.level_lines import ContactFinder, ContactRegion
from tactflow.vision.contact.level_tree import grow_level_lines

Float = NDArray[np.float32]
SHAPE = 60, 80
UNKNOWN = np.eye(3, dtype=np.float32)
"""Mixtures of which nobody knows what they show."""


def bump(x: float, y: float, radius: float, high: float = 1.0, shape: tuple[int, int] = SHAPE) -> Float:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    away = ((columns - x) ** 2 + (rows - y) ** 2) / radius**2
    return np.asarray(high * np.exp(-(away**2)), np.float32)


def slopes(surface: Float) -> Float:
    """(2, h, w), along x and y."""
    down, across = np.gradient(surface)
    return np.asarray(np.stack([across, down]), np.float32)


def seen(surface: Float, lamps: NDArray[np.float64]) -> Float:
    """Change of three channels, with noise; lamps : (3, 2), how each answers to slopes."""
    noise = np.random.default_rng(0).normal(0, 0.002, (3, *surface.shape))
    return np.asarray(np.tensordot(lamps, slopes(surface), 1) + noise, np.float32)


def regions(heights: Heights, changed: NDArray[np.bool_] | None = None) -> list[ContactRegion]:
    return ContactFinder()(heights, np.ones(heights.values.shape, np.bool_) if changed is None else changed)


def plain_lines(heights: Float, levels: Float, least: int) -> list[tuple[float, ...]]:
    """Of each line: level, cells inside, sides along it and along the border, and the sum of its slopes."""
    lines = []
    for index, level in enumerate(levels):
        holes = np.ones((3, 3), np.bool_)
        filled = ndimage.binary_fill_holes(np.pad(heights > level, 1), holes)[1:-1, 1:-1]
        labels, count = ndimage.label(filled)
        for label in range(1, count + 1):
            inside = np.pad(labels == label, 1)
            if inside.sum() < least:
                continue
            sides, border, drop = 0, 0, 0.0
            z = np.pad(heights, 1, constant_values=np.nan)
            for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                outside, beside = np.roll(inside, shift, (0, 1)), np.roll(z, shift, (0, 1))
                fall = (z - beside)[inside & ~outside]
                sides += np.isfinite(fall).sum()
                border += np.isnan(fall).sum()
                drop += float(np.nansum(fall))
            lines.append((index, inside.sum(), sides, border, round(drop, 2)))
    return sorted(lines)


def grown(
    heights: Float, changed: NDArray[np.bool_], levels: Float, least: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], Float]:
    """What `grow_level_lines` fills: of each cell the innermost line, and the lines with their drops."""
    within, drops = np.empty(heights.shape, np.int32), np.empty(heights.size * 4, np.float32)
    lines = np.empty((len(drops), 7), np.int32)
    count = grow_level_lines(heights, changed.astype(np.uint8), levels, least, within, drops, lines)
    return within, lines[:count], drops[:count]


def core(region: ContactRegion, shape: tuple[int, int] = SHAPE) -> NDArray[np.bool_]:
    cells = np.zeros(shape, np.bool_)
    cells[region.rows, region.columns] = region.core > 0
    return cells


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 24), st.integers(1, 24))
def test_each_level_line_is_measured(seed: int, high: int, wide: int) -> None:
    noise = np.random.default_rng(seed).normal(0, 9, (high, wide)).astype(np.float32)
    heights = np.asarray(cv2.blur(noise, (3, 3)), np.float32)
    levels = np.linspace(heights.min() - 1, heights.max(), 6, dtype=np.float32)[1:-1]
    _, lines, drops = grown(heights, heights > 1, levels, 2)
    level, _, cells, _, sides, border, _ = lines.T
    found = zip(level, cells, sides, border, drops.astype(float), strict=True)
    expected = plain_lines(heights, levels, 2)
    for one, other in zip(sorted(found), expected, strict=True):
        assert one[:4] == other[:4]
        assert abs(one[4] - other[4]) < 0.05


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**16))
def test_lines_lie_within_one_another_and_count_the_marked_cells(seed: int) -> None:
    heights = np.asarray(cv2.blur(np.random.default_rng(seed).normal(0, 9, (20, 30)), (3, 3)), np.float32)
    changed = heights > heights.mean()
    levels = np.linspace(0, heights.max(), 14, dtype=np.float32)[1:-1]
    within, lines, _ = grown(heights, changed, levels, 9)
    holes = np.ones((3, 3), np.bool_)
    for index, (level, cell, cells, marked, _, _, outer) in enumerate(lines):
        labels = ndimage.label(ndimage.binary_fill_holes(heights > levels[level], holes))[0]
        inside = labels == labels.flat[cell]
        assert cells == inside.sum()
        assert marked == (inside & changed).sum()
        # The cells inside lie within this line or one that it encloses.
        nested = {index}
        for inner in range(index - 1, -1, -1):
            nested |= {inner} if lines[inner, 6] in nested else set()
        assert np.array_equal(np.isin(within, list(nested)), inside)
        if outer >= 0:
            assert lines[outer, 0] == level - 1


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**16))
def test_contacts_have_no_cell_in_common(seed: int) -> None:
    draw = np.random.default_rng(seed)
    bumps = [bump(*draw.uniform(5, 55, 2), draw.uniform(3, 15), draw.uniform(0.5, 1)) for _ in range(4)]
    found = [core(region) for region in regions(Heights(np.asarray(sum(bumps), np.float32), UNKNOWN))]
    assert np.sum(found, axis=0).max() == 1


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**16))
def test_whatever_colours_answer_to_slopes_the_surface_is_found_up_to_a_factor(seed: int) -> None:
    draw = np.random.default_rng(seed)
    lamps = draw.normal(0, 1, (3, 2))
    lamps[:2] += 1.5 * np.eye(2)
    # A slope that shows less than a tenth as strongly as the other one is taken for noise.
    assume(np.linalg.cond(lamps) < 1 / 0.15)
    surface = bump(*draw.uniform(25, 35, 2), draw.uniform(6, 12)) + bump(55, 35, 5, 0.4)
    heights = HeightModel()(seen(surface, lamps))
    assert heights.sloping
    # Measured: 0.9994 at least.
    assert abs(np.corrcoef(heights.values.ravel(), surface.ravel())[0, 1]) > 0.99


def test_a_cylinder_shows_one_slope_and_is_found_after_a_ball() -> None:
    lamps = np.array([[1.0, 0.2], [-0.4, 0.9], [-0.5, -1.0]])
    model = HeightModel()
    model(seen(bump(40, 30, 10), lamps))
    ridge = np.asarray(np.exp(-(((np.mgrid[:60, :80][1] - 40) / 6.0) ** 4)), np.float32)
    heights = model(seen(ridge, lamps))
    assert abs(np.corrcoef(heights.values[20:40].ravel(), ridge[20:40].ravel())[0, 1]) > 0.95


@pytest.mark.parametrize("sign", [1, -1])
def test_what_brightens_or_darkens_as_a_whole_is_depth(sign: int) -> None:
    surface = bump(40, 30, 10, 20)
    heights = HeightModel()(np.stack([sign * surface] * 3))
    assert len(heights.mixtures) == 1
    assert np.corrcoef(heights.values.ravel(), surface.ravel())[0, 1] > 0.99


def test_what_changes_its_hue_as_a_whole_is_depth() -> None:
    surface = bump(40, 30, 10, 20)
    heights = HeightModel()(np.stack([surface, 0 * surface, -surface]))
    assert abs(heights.mixtures @ [1, 0, -1]) == pytest.approx(np.sqrt(2))


def test_coloured_changes_that_are_no_slopes_are_of_unknown_kind() -> None:
    noise = np.random.default_rng(0).normal(0, 20, (3, 15, 20)).astype(np.float32)
    change = np.stack([cv2.resize(plane, SHAPE[::-1]) for plane in noise])
    assert HeightModel()(change).mixtures.shape == (3, 3)


@pytest.mark.parametrize("lamp", [(1, 0), (0, -1), (0.6, 0.8)])
def test_a_gray_camera_shows_one_slope_from_which_the_shape_is_found(lamp: tuple[float, float]) -> None:
    surface = bump(40, 30, 10)
    model = HeightModel()
    heights = model(20 * seen(surface, np.array([lamp] * 3)))
    assert heights.sloping
    assert model.alike
    # Measured: 0.89 at least, as it is blurred along the direction in which no slope shows.
    assert abs(np.corrcoef(heights.values.ravel(), surface.ravel())[0, 1]) > 0.87
    (region,) = regions(heights)
    assert (core(region) & (surface > 0.5)).sum() > 0.95 * (surface > 0.5).sum()


def test_a_shaded_flank_that_shows_more_than_the_lit_one_does_not_pull_the_contact() -> None:
    surface = bump(40, 30, 10)
    lit = 0.08 * slopes(surface)[0] / np.abs(slopes(surface)[0]).max()
    uneven = 100 * (lit - 3 * lit**2)
    heights = HeightModel()(np.stack([uneven.astype(np.float32)] * 3))
    assert heights.slopes is not None
    steep = np.hypot(*heights.slopes)
    columns = np.arange(SHAPE[1])
    left, right = (float(steep[30, side].max()) for side in (columns < 40, columns > 40))
    # The two flanks of the change itself differ by a factor of 1.6.
    assert 0.9 < left / right < 1.1


def test_without_any_change_a_gray_camera_shows_a_gel_at_rest() -> None:
    model = HeightModel()
    model(20 * seen(bump(40, 30, 10), np.array([(1, 0)] * 3)))
    heights = model(np.zeros((3, *SHAPE), np.float32))
    assert not heights.values.any()
    assert regions(heights) == []


@pytest.mark.parametrize("place", [(20, 20), (60, 40), (30, 45)])
def test_lamps_all_around_a_gray_camera_show_both_flanks_of_one_contact(place: tuple[int, int]) -> None:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    outwards = np.stack([columns - 40, rows - 30]) / (np.hypot(columns - 40, rows - 30) + 1)
    model = HeightModel()
    for x, y in ((20, 20), (60, 40), (60, 15), (20, 45), place):
        surface = bump(x, y, 8)
        heights = model(np.asarray(np.stack([20 * (outwards * slopes(surface)).sum(axis=0)] * 3), np.float32))
    assert heights.sloping
    (region,) = regions(heights)
    assert (core(region) & (surface > 0.5)).sum() > 0.95 * (surface > 0.5).sum()
    assert core(region).sum() < 2.5 * (surface > 0.5).sum()


def test_a_change_of_nothing_has_no_lines() -> None:
    heights = HeightModel()(np.zeros((3, *SHAPE), np.float32))
    levels = np.zeros(12, np.float32)
    assert not len(grown(heights.values, np.ones(SHAPE, np.bool_), levels, 9)[1])
    assert regions(heights) == []


def test_an_object_in_a_moat_is_the_contact_whichever_way_it_points() -> None:
    surface = bump(40, 30, 8) - 0.3 * bump(40, 30, 16)
    for sign in (1, -1):
        (region,) = regions(Heights(sign * surface, np.zeros((2, 3), np.float32)))
        assert core(region)[30, 40]
        assert 100 < core(region).sum() < 260


def test_two_objects_are_two_contacts_and_a_faint_wrinkle_is_none() -> None:
    surface = bump(20, 30, 8) + bump(55, 30, 8, 0.8) + bump(40, 50, 5, 0.05)
    found = regions(Heights(surface, UNKNOWN))
    assert [bool(core(region)[30, x]) for region, x in zip(found, (20, 55), strict=True)] == [True, True]


def test_a_contact_encloses_cells_that_have_changed() -> None:
    surface, changed = bump(20, 30, 8) + bump(55, 30, 8, 0.8), np.zeros(SHAPE, np.bool_)
    changed[28:32, 53:57] = True
    (region,) = regions(Heights(surface, UNKNOWN), changed)
    assert core(region)[30, 55]


def test_a_ring_is_outlined_around_and_not_within() -> None:
    rows, columns = np.mgrid[:60, :80]
    ring = np.exp(-(((np.hypot(columns - 40, rows - 30) - 15) / 4.0) ** 4)).astype(np.float32)
    (region,) = regions(Heights(ring, np.zeros((2, 3), np.float32)))
    assert core(region)[30, 25]
    assert core(region)[30, 40]


def test_a_contact_that_the_border_cuts_off_is_found() -> None:
    (region,) = regions(Heights(bump(40, 0, 12), UNKNOWN))
    assert core(region)[0, 40]
