"""Loops in C do what their namesakes in NumPy do; where there is no C, a run says so and gives the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import tactflow
from tactflow.tools.stress.compare import difference, numbers
from tactflow.vision import compiled
from tactflow.vision.change.rest import find_excess, sum_tiles
from tactflow.vision.contact.background_kernels import smooth_cells
from tactflow.vision.contact.certainty import largest_deviations
from tactflow.vision.contact.components import contact_cells
from tactflow.vision.contact.contact_outline import draw_level, largest_nearby, outline_level
from tactflow.vision.contact.heights import smooth_range
from tactflow.vision.contact.level_lines import fill_region, select_contacts
from tactflow.vision.contact.level_tree import grow_level_lines
from tactflow.vision.depth.poisson import divergence, solve_down
from tactflow.vision.depth.slopes import BAND_ROWS, coordinates, slopes_of_colour
from tactflow.vision.depth.surface import relative_change, slope_misfit
from tactflow.vision.depth.surroundings import light_around
from tactflow.vision.flow.registration import compare_light
from tactflow.vision.geometry.direction import sum_harmonics
from tactflow.vision.geometry.downsample import halve
from tactflow.vision.geometry.hull import convex_hull, row_ends
from tactflow.vision.geometry.region import sum_pixels
from tactflow.vision.markers.detection import move_to_centroids
from tactflow.vision.pose.align import compare_points

needs_compiler = pytest.mark.skipif(
    not compiled.are_compiled(), reason="tactflow was installed without a C compiler"
)


def run_plain(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command with loops in NumPy."""
    command = [sys.executable, "-m", "tactflow", *words]
    environment = {**os.environ, "TACTFLOW_PLAIN": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)


@needs_compiler
@pytest.mark.parametrize(
    ("pipeline", "scene"), [("default", "press"), ("default", "cable"), ("markerless", "unmarked")]
)
def test_results_are_the_same_in_c_and_in_numpy(
    pipeline: str, scene: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def results() -> list[dict[str, Any]]:
        found = tactflow.stream(pipeline, source=f"sim:{scene}?frames=24", settings={"sinks": {}})
        return [numbers(result) for result in found]

    fast = results()
    for loop in compiled.kernels():
        monkeypatch.setattr(loop, "compiled", loop.plain)
    for one, other in zip(fast, results(), strict=True):
        assert max(difference(one, other).values()) < 1e-3


@needs_compiler
@pytest.mark.parametrize("seed", range(4))
def test_centroids_are_the_same_in_c_and_in_numpy(seed: int) -> None:
    random = np.random.default_rng(seed)
    gray = random.uniform(0, 255, (30, 41)).astype(np.float32)
    radii = random.uniform(1.0, 4.0, 25)
    # Some lie beyond the border.
    fast = random.uniform(-2, 42, (25, 2))
    slow = fast.copy()
    arguments = gray, radii, 1.4 * radii, 1.9 * radii + 1.5, 1.6 * radii + 0.5, 1e-3
    move_to_centroids.compiled(*arguments, fast)
    move_to_centroids.plain(*arguments, slow)
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


@needs_compiler
@pytest.mark.parametrize("seed", range(4))
def test_level_lines_are_the_same_in_c_and_in_numpy(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=(30, 41)).astype(np.float32)
    heights = np.ascontiguousarray(cv2.GaussianBlur(noise, (0, 0), 2.0))
    marked = (noise > 1).astype(np.uint8)
    levels = np.linspace(heights.min(), heights.max(), 12, dtype=np.float32)[1:-1]
    found = []
    for grow in (grow_level_lines.compiled, grow_level_lines.plain):
        within, drops = np.zeros(heights.shape, np.int32), np.zeros(2000, np.float32)
        lines = np.zeros((2000, 7), np.int32)
        count = grow(heights, marked, levels, 2, within, drops, lines)
        sizes = [*map(tuple, lines[:count, [0, 2, 3, 4, 5]])]
        around = [sizes[line[6]] if line[6] >= 0 else None for line in lines[:count]]
        innermost = np.append(lines[:count, [0, 2, 3, 4, 5]], [[-1] * 5], axis=0)[within]
        found.append((innermost, sorted(zip(sizes, drops[:count].round(3), around, strict=True), key=str)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    for (size, drop, around), (other_size, other_drop, other_around) in zip(
        found[0][1], found[1][1], strict=True
    ):
        assert (size, around) == (other_size, other_around)
        assert drop == pytest.approx(other_drop, abs=2e-3)


@needs_compiler
@pytest.mark.parametrize("seed", range(8))
def test_contacts_are_the_same_in_c_and_in_numpy(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=(40, 51)).astype(np.float32)
    heights = np.ascontiguousarray(cv2.GaussianBlur(noise, (0, 0), 4.0))
    levels = np.linspace(0, heights.max(), 14, dtype=np.float32)[1:-1]
    within, drops = np.empty(heights.shape, np.int32), np.empty(3000, np.float32)
    lines, contacts = np.empty((3000, 7), np.int32), np.empty((2, *heights.shape), np.int32)
    count = grow_level_lines(heights, (noise > 2).astype(np.uint8), levels, 9, within, drops, lines)
    boxes = np.empty((2, count, 4), np.int32)
    found = [
        select(lines[:count], drops[:count], within, into, box, 0.5, 0.5, 0.6, 0.5)
        for select, into, box in zip(
            (select_contacts.compiled, select_contacts.plain), contacts, boxes, strict=True
        )
    ]
    assert found[0] == pytest.approx(found[1])
    assert found[0][0] > 0
    np.testing.assert_array_equal(*contacts)
    np.testing.assert_array_equal(*boxes[:, : int(found[0][0])])
    for near in range(1, 2 * int(found[0][0]), 2):
        inside, cores = np.empty((2, 30, 35), np.bool_), np.empty((2, 2, 30, 35), np.uint8)
        fill_region.compiled(contacts[0], near, 3, 9, 3, inside[0], cores[0])
        fill_region.plain(contacts[0], near, 3, 9, 3, inside[1], cores[1])
        np.testing.assert_array_equal(*inside)
        np.testing.assert_array_equal(*cores)


@needs_compiler
@pytest.mark.parametrize("seed", range(8))
def test_cells_in_contact_are_the_same_in_c_and_in_numpy(seed: int) -> None:
    draw = np.random.default_rng(seed)
    size = tuple(draw.integers(1, 40, 2))
    squared = np.asarray(cv2.GaussianBlur(draw.normal(size=size), (0, 0), 1.0) ** 2 * 40, np.float32)
    before = cv2.GaussianBlur(draw.normal(size=size), (0, 0), 2.0) > 0.2
    found = np.empty((2, *size), np.bool_)
    arguments = squared, 3.0, 20.0, 8.0, before, 4
    counts = [
        cells(*arguments, into)
        for cells, into in zip((contact_cells.compiled, contact_cells.plain), found, strict=True)
    ]
    assert counts[0] == counts[1] == found[0].sum()
    np.testing.assert_array_equal(*found)


@needs_compiler
@pytest.mark.parametrize("seed", range(8))
def test_outlines_are_the_same_in_c_and_in_numpy(seed: int) -> None:
    draw = np.random.default_rng(seed)
    high, wide = (int(side) for side in draw.integers(1, 24, 2))
    noise = cv2.GaussianBlur(draw.normal(size=(2 * high, 2 * wide)), (0, 0), 1.5)
    values = np.maximum(np.asarray(5 * noise, np.float32), 0)
    core = (draw.random((high, wide)) > 0.95).astype(np.uint8)
    nearby, level = np.empty((2, *values.shape), np.float32), np.empty((2, *values.shape), np.float32)
    mask = np.zeros((2, 4 * high - 1, 4 * wide + 3), np.uint8)
    for index, kind in enumerate(("compiled", "plain")):
        getattr(largest_nearby, kind)(values, 0.55, nearby[index])
        getattr(outline_level, kind)(values, 0.5, core, level[index])
        getattr(draw_level, kind)(level[0], 1, 4, mask[index])
    np.testing.assert_allclose(*nearby, rtol=1e-5)
    np.testing.assert_array_equal(*level)
    np.testing.assert_array_equal(*mask)
    assert smooth_range.compiled(values) == pytest.approx(smooth_range.plain(values), rel=1e-6)


@needs_compiler
def test_loops_of_the_height_map_are_the_same_in_c_and_in_numpy() -> None:
    random = np.random.default_rng(0)
    change = random.normal(0, 0.3, (37, 61, 3)).astype(np.float32)
    level = random.uniform(0.3, 1, change.shape).astype(np.float32)
    picture = random.integers(0, 256, (37, 183), np.uint8)
    near = np.ones((5, 61), np.uint8)
    near[1, :20] = near[3] = 0
    coefficients = random.normal(0, 0.3, (2, 19, 6)).astype(np.float32)
    shift = -random.uniform(1e-4, 4, 61).astype(np.float32)
    distance = random.uniform(0, 9, (37, 61)).astype(np.float32)
    gain = np.array([0.9, 1.0, 1.2], np.float32)
    found = []
    for name in ("compiled", "plain"):
        growth, rings = np.empty(3, np.float32), np.zeros((2, 9))
        getattr(light_around, name)(change, level, distance, 2, 0.5, growth, rings)
        relative = np.empty((30, 90), np.float32)
        getattr(relative_change, name)(picture, picture[::-1].copy(), 5, 30, gain, 20.0, relative)
        slope = np.zeros((2, 37, 61), np.float32)
        place = coordinates((61, 37))
        getattr(slopes_of_colour, name)(change, coefficients, *place, near, 0.6, slope, BAND_ROWS, 12, 0.95)
        heights = np.empty((37, 61), np.float32)
        getattr(divergence, name)(slope, -0.1, -0.2, 1, -1, -1, 1, heights)
        getattr(solve_down, name)(heights, shift, -1, 1)
        misfit = getattr(slope_misfit, name)(slope, heights, picture[:, :61] // 200, 0.1, 0.2)
        found.append((growth, rings, relative, slope, heights, np.array(misfit)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4 * np.abs(other).max())


@needs_compiler
@pytest.mark.parametrize("seed", range(12))
def test_the_shape_of_a_mask_is_the_same_in_c_and_in_numpy(seed: int) -> None:
    draw = np.random.default_rng(seed)
    size = tuple(draw.integers(1, 40, 2))
    mask = (draw.random(size) > draw.random()).astype(np.uint8) * np.uint8(7)
    totals = np.empty((2, 10), np.int64)
    sum_pixels.compiled(mask, totals[0])
    sum_pixels.plain(mask, totals[1])
    np.testing.assert_array_equal(*totals)
    ends = np.zeros((2, 2 * len(mask), 2), np.int32)
    assert row_ends.compiled(mask, ends[0]) == row_ends.plain(mask, ends[1])
    np.testing.assert_array_equal(*ends)
    points = np.ascontiguousarray(np.argwhere(mask)[:, ::-1], np.int32)
    if not len(points):
        return
    corners = np.zeros((2, *points.shape), np.int32)
    found = [
        hull(points, into)
        for hull, into in zip((convex_hull.compiled, convex_hull.plain), corners, strict=True)
    ]
    assert found[0] == found[1]
    hulls = [part[: int(found[0][0])].tolist() for part in corners]
    start = hulls[1].index(hulls[0][0])
    assert hulls[0] == hulls[1][start:] + hulls[1][:start]
    cells = draw.random((2, -(-size[0] // 4), -(-size[1] // 4)), np.float32)
    hull = corners[0][: int(found[0][0])].astype(float)
    largest = [getattr(largest_deviations, kind)(cells, mask, hull, 4) for kind in ("compiled", "plain")]
    assert largest[0] == largest[1]
    harmonics = np.ones((2, 7, 2))
    to_circle = np.array([*points.mean(axis=0), 3.0, 0.4, 2.5])
    sum_harmonics.compiled(points, to_circle, 1e-9, 3, harmonics[0])
    sum_harmonics.plain(points, to_circle, 1e-9, 3, harmonics[1])
    np.testing.assert_allclose(*harmonics, rtol=1e-9, atol=1e-9 * np.abs(harmonics).max())


@needs_compiler
def test_sums_over_tiles_are_the_same_in_c_and_in_numpy() -> None:
    draw = np.random.default_rng(0)
    picture = draw.integers(0, 256, (40, 90), np.uint8)
    used = np.sort(draw.permutation(40)[:15])
    slopes = draw.integers(-1020, 1021, (2, 15, 24)).astype(np.int16)
    at_rest = draw.integers(-(10**6), 10**6, (2, 3, 4))
    factor = draw.random((2, 3, 4), np.float32)
    found = []
    for kind in ("compiled", "plain"):
        light, shift = np.empty((3, 3, 4), np.float32), np.empty((2, 3, 4), np.float32)
        getattr(sum_tiles, kind)(picture, 9, used, slopes, at_rest, factor, light, shift)
        excess = getattr(find_excess, kind)(light[0], light[1], 0.05, shift, shift[::-1].copy(), factor)
        found.append((light, shift, np.array(excess)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6 * np.abs(other).max())


@needs_compiler
def test_comparisons_with_a_template_are_the_same_in_c_and_in_numpy() -> None:
    draw = np.random.default_rng(0)
    count = 60
    change = draw.normal(0, 20, (20, 30, 4)).astype(np.float32)
    change[..., 3] = draw.random((20, 30)) < 0.95
    away = draw.uniform(-14, 14, (count, 2)).astype(np.float32)
    light = draw.normal(0, 20, (count, 3)).astype(np.float32)
    by = draw.normal(size=(count, 3, 5)).astype(np.float32)
    patches = np.arange(count) // 7
    planes = np.concatenate([draw.uniform(-0.6, 0.6, (20, 30, 3)), draw.random((20, 30, 1))], axis=2)
    motion = np.eye(4)
    motion[:3, 3] = 0.1, -0.2, 0.05
    motion[:2, :2] = [[0.995, -0.1], [0.1, 0.995]]
    points = draw.uniform(0, 2, (count, 6))
    found = []
    for kind in ("compiled", "plain"):
        error, sums = np.empty((count, 3), np.float32), np.empty(10)
        warp = np.array([0.9, 0.2, 15.0, 10.0])
        visible = getattr(compare_light, kind)(change, warp, 1.1, away, light, by, patches, error, sums)
        parts = [np.zeros(shape) for shape in ((count, 2), count, (7, 7), 8, 2)]
        getattr(compare_points, kind)(
            planes.astype(np.float32), np.zeros(2), np.array([0.08, 0.1]), motion, points,
            np.arange(count * 18.0).reshape(count, 3, 6), 0.3, *parts,
        )  # fmt: skip
        found.append((np.array(visible), error, sums, *parts))
    assert 0 < found[0][0] < count
    assert 0 < found[0][-1][0] < count
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6 * np.abs(other).max())


@needs_compiler
def test_a_loop_refuses_arrays_of_other_types_and_orders() -> None:
    half = np.zeros((4, 12), np.uint8)
    for wrong in (
        np.zeros((3, 2, 2)),
        np.zeros((2, 2), np.float32),
        np.zeros((3, 2, 4), np.float32)[:, :, ::2],
    ):
        with pytest.raises((TypeError, ValueError, BufferError)):
            smooth_cells(half, wrong)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="required the arguments"):
        smooth_cells(half)  # type: ignore[call-arg]


@needs_compiler
def test_a_loop_does_not_write_to_what_is_read_only() -> None:
    half = np.zeros((2, 6), np.uint8)
    half.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        halve(np.zeros((4, 12), np.uint8), 0, 0, half)


def test_warmup_says_whether_loops_are_compiled(tmp_path: Path) -> None:
    done = run_plain(tmp_path, "warmup")
    assert done.stdout == ""
    assert "TACTFLOW_PLAIN is set: loops run in NumPy" in done.stderr
