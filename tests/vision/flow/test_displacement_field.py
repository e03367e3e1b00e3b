"""The displacement field between markers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tactflow.sim import open_scene
from tactflow.vision.flow import FieldModel, flow_in_mask, flow_of_field
from tactflow.vision.flow.displacement_field import NUGGET_VARIANCE, matern
from tactflow.vision.types import Markers, MarkerStatus

X, Y = np.meshgrid(np.arange(20.0, 300, 40), np.arange(20.0, 400, 40))
GRID = np.column_stack([X.ravel(), Y.ravel()])
SIZE = (300, 400)
RNG = np.random.default_rng(5)
NOISE = 0.02


def markers(moved: np.ndarray, status: np.ndarray | None = None) -> Markers:
    status = np.zeros(len(GRID), np.uint8) if status is None else status
    return Markers(GRID, GRID + moved, status, np.full(len(GRID), NOISE))


def field_of(given: Markers) -> Any:
    return FieldModel(given.origin, SIZE)(given)


def waves(points: np.ndarray) -> np.ndarray:
    """A smooth displacement (N, 2), px, of points (N, 2), px."""
    x, y = points.T
    return np.column_stack([5 * np.sin(x / 60 + 0.3) * np.cos(y / 80), 4 * np.cos(x / 90) * np.sin(y / 70)])


def disc(center: tuple[float, float], radius: float) -> np.ndarray:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    return np.where(np.hypot(x - center[0], y - center[1]) <= radius, 255, 0).astype(np.uint8)


def bar(center: tuple[float, float], length: float, width: float) -> np.ndarray:
    y, x = np.abs(np.mgrid[: SIZE[1], : SIZE[0]] - np.array(center)[::-1, None, None])
    return np.where((x <= length / 2) & (y <= width / 2), 255, 0).astype(np.uint8)


def krige(origin: np.ndarray, moved: np.ndarray, extra: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The plain way: solve for every frame anew. extra : (N,), variance of each marker, relative."""
    length = FieldModel(GRID, SIZE).pitch * 1.5

    def kernel(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return matern(np.linalg.norm(one[:, None] - other, axis=2) / length)

    return kernel(places, origin) @ np.linalg.solve(
        kernel(origin, origin) + np.diag(extra + NUGGET_VARIANCE), moved
    )


def test_it_is_kriging_with_a_matern_kernel() -> None:
    moved = RNG.normal(0, 3, GRID.shape)
    field = field_of(markers(moved))
    expected = krige(GRID, moved, np.zeros(len(GRID)), field.grid.points.reshape(-1, 2))
    np.testing.assert_allclose(field.displacement.reshape(-1, 2), expected, atol=1e-8)


@pytest.mark.parametrize("unseen", [MarkerStatus.LOST, MarkerStatus.INFERRED])
def test_a_marker_that_is_not_seen_is_as_if_it_had_never_been_there(unseen: MarkerStatus) -> None:
    moved = RNG.normal(0, 3, GRID.shape)
    gone = [3, 17, 18, 40]
    status = np.zeros(len(GRID), np.uint8)
    status[gone] = unseen
    moved[gone] = 500.0  # wherever it is said to be
    field = field_of(markers(moved, status))
    rest = np.delete(np.arange(len(GRID)), gone)
    expected = krige(GRID[rest], moved[rest], np.zeros(len(rest)), field.grid.points.reshape(-1, 2))
    np.testing.assert_allclose(field.displacement.reshape(-1, 2), expected, atol=1e-7)
    fewer = markers(moved)
    fewer = replace(fewer, origin=GRID[rest], position=fewer.position[rest], status=fewer.status[rest])
    without = field_of(replace(fewer, stderr=fewer.stderr[rest]))
    for mask in (disc((100, 100), 25), disc((150, 200), 120)):
        one, other = field.motion(mask), without.motion(mask)
        assert one.mean == pytest.approx(other.mean, abs=1e-7)
        assert one.stderr == pytest.approx(other.stderr, rel=1e-6)
        assert one.gradient.dx_stderr == pytest.approx(other.gradient.dx_stderr, rel=1e-6)
        assert one.gradient.dy_stderr == pytest.approx(other.gradient.dy_stderr, rel=1e-6)
    # There is more to be wrong about where it was.
    everywhere = field_of(markers(np.where(status[:, None] == 0, moved, 0.0)))
    row, column = np.unravel_index(
        np.argmin(np.linalg.norm(field.grid.points - GRID[17], axis=2)), field.grid.shape
    )
    assert field.stderr[row, column] > 3 * everywhere.stderr[row, column]


def test_it_is_known_at_any_place_and_beyond_its_grid_as_at_the_border() -> None:
    field = field_of(markers(waves(GRID)))
    points = field.grid.points.reshape(-1, 2)
    np.testing.assert_allclose(field.at(points), field.displacement.reshape(-1, 2), atol=1e-3)
    halfway = (points[:1] + points[1:2]) / 2
    np.testing.assert_allclose(field.at(halfway)[0], field.displacement[0, :2].mean(axis=0), atol=0.02)
    np.testing.assert_allclose(field.at(points[:1] - 1000)[0], field.displacement[0, 0])


def test_a_marker_that_is_seen_poorly_counts_less() -> None:
    moved = waves(GRID)
    off = 24
    moved[off] += 3.0
    sure, unsure = markers(moved), markers(moved)
    unsure.stderr[off] = 3.0
    place = np.linalg.norm(field_of(sure).grid.points - GRID[off], axis=2).argmin()
    errors = [
        np.abs(field_of(given).displacement.reshape(-1, 2)[place] - waves(GRID[[off]])[0]).max()
        for given in (sure, unsure)
    ]
    assert errors[0] > 2
    assert errors[1] < 0.5


@pytest.mark.parametrize("mask", [disc((152, 199), 60), bar((152, 199), 100, 40)])
def test_a_part_that_moves_as_a_whole_is_told_so(mask: np.ndarray) -> None:
    turn, growth, shift = math.radians(3), 0.04, np.array([2.0, -1.0])
    middle = np.array([150.0, 200.0])
    arms = GRID - middle
    moved = shift + growth * arms + math.tan(turn) * arms[:, ::-1] * [-1, 1]
    field = field_of(markers(moved))
    flow = flow_of_field(field, markers(moved), mask)
    assert flow.residual == pytest.approx(0, abs=0.05)
    # Clockwise on the screen, since y points down.
    rotation = -math.degrees(math.atan2(math.tan(turn), 1 + growth))
    assert flow.rotation == pytest.approx(rotation, abs=3 * flow.rotation_stderr)
    area = (1 + growth) ** 2 + math.tan(turn) ** 2 - 1
    assert flow.divergence == pytest.approx(area, abs=3 * flow.divergence_stderr)
    assert flow.shear == pytest.approx((0, 0), abs=3 * flow.shear_stderr)
    # The gel in the disc was where this motion takes it from.
    matrix = np.array([[1 + growth, -math.tan(turn)], [math.tan(turn), 1 + growth]])
    was = middle + np.linalg.solve(matrix, np.array([152.0, 199.0]) - shift - middle)
    assert flow.mean == pytest.approx(tuple(np.array([152, 199]) - was), abs=3 * min(flow.stderr))


def test_the_stated_error_of_the_mean_covers_an_outline_off_by_a_third_of_its_radius() -> None:
    away = np.maximum(np.hypot(*(GRID - (150, 200)).T) - 60, 0)
    dragged = np.exp(-away / 20)[:, None] * (4.0, 0.0)
    field = field_of(markers(dragged))
    true = field.motion(disc((150, 200), 60))
    ratios = []
    for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        center = (150 + 20 * math.cos(angle), 200 + 20 * math.sin(angle))
        flow = flow_of_field(field, markers(dragged), disc(center, 60))
        ratios.append((flow.mean[0] - true.mean[0]) / flow.stderr[0])
    assert np.sqrt(np.mean(np.square(ratios))) < 0.5


def test_the_mean_is_the_integral_of_the_field_over_the_gel_in_contact() -> None:
    field = field_of(markers(waves(GRID)))
    mask = disc((140, 180), 45)
    motion = field.motion(mask)
    x, y = np.meshgrid(np.arange(80.0, 200, 0.5), np.arange(120.0, 240, 0.5))
    rest = np.column_stack([x.ravel(), y.ravel()])
    moved = krige(GRID, waves(GRID), np.zeros(len(GRID)), rest)
    now = np.rint(rest + moved).astype(int)
    inside = mask[now[:, 1], now[:, 0]] > 0
    assert motion.mean == pytest.approx(tuple(moved[inside].mean(axis=0)), abs=0.01)


def test_a_marker_that_enters_the_contact_makes_no_jump() -> None:
    moved = np.zeros_like(GRID)
    moved[24] = (6.0, 0.0)  # at (140, 140) in the reference
    given = replace(markers(moved), radius=5.0)
    field = field_of(given)
    masks = [disc((192 - step, 141), 45.3) for step in range(5)]
    integral = np.array([flow_of_field(field, given, mask).mean for mask in masks])
    plain = np.array([flow_in_mask(given, mask).mean for mask in masks])
    assert np.abs(np.diff(plain[:, 0])).max() > 1  # one of five markers that moved by 6 px
    assert np.abs(np.diff(integral[:, 0])).max() < 0.2


def test_stated_errors_are_those_of_simulated_contacts() -> None:
    """Independent contacts; one contact's errors are alike in all of its frames."""
    ratio = []
    for name, seed in [(name, seed) for name in ("press", "slide", "box", "twist") for seed in range(20, 30)]:
        truth = open_scene(f"{name}?frames=300&seed={seed}").truth(55)
        count = len(truth.origin)
        noise = RNG.normal(0, NOISE, (count, 2))
        seen = np.where(truth.visible, MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
        given = Markers(truth.origin, truth.position + noise, seen, np.full(count, NOISE))
        field = FieldModel(truth.origin, (800, 600))(given)
        motion = field.motion(np.uint8(255) * truth.contact_mask)
        ratio.extend(np.subtract(motion.mean, truth.contact_flow) / motion.stderr)
    within = [float(np.mean(np.abs(ratio) < bound)) for bound in (1, 2)]
    # 80 errors: the binomial standard deviation of a share of 68 % is 5 %, of 95 % it is 2.4 %.
    assert within[0] > 0.68 - 2 * 0.05
    assert within[1] > 0.95 - 2 * 0.024


def test_each_region_has_its_own_motion_whatever_was_asked_before() -> None:
    first, second = disc((100, 100), 60), disc((200, 300), 40)
    asked, other = field_of(markers(waves(GRID))), field_of(markers(waves(GRID)))
    assert asked.motion(first) == asked.motion(first.copy()) != asked.motion(second)
    assert asked.motion(second) == other.motion(second)


def test_where_no_marker_is_near_the_mean_is_not_known() -> None:
    given = markers(np.full_like(GRID, 2.0))
    origin = GRID[GRID[:, 1] < 200]
    cut = Markers(origin, origin + 2.0, given.status[: len(origin)], given.stderr[: len(origin)])
    field = FieldModel(origin, SIZE)(cut)
    assert flow_of_field(field, cut, disc((150, 340), 30)).mean is None
    assert flow_of_field(field, cut, disc((150, 100), 30)).mean is not None
    assert field.motion(np.zeros((400, 300), np.uint8)) is None


def test_a_contact_that_fills_the_picture_has_no_outline_that_could_err() -> None:
    """Every cell lies inside: what rounding makes of 1 is at no border."""
    everywhere = np.full((400, 300), 255, np.uint8)
    motion = field_of(markers(-0.05 * (GRID - (150, 200)))).motion(everywhere)
    assert motion.gradient.growth[0] == pytest.approx(-0.05, abs=0.005)
    assert max(motion.outline_stderr) < 1e-3


@pytest.mark.parametrize("origin", [np.zeros((2, 2)), np.zeros((5, 3)), np.zeros(6)])
def test_too_few_markers_for_a_field_are_refused(origin: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"required an origin of shape \(N, 2\) with N >= 3"):
        FieldModel(origin, SIZE)


def test_markers_of_another_reference_and_other_masks_are_refused() -> None:
    model = FieldModel(GRID, SIZE)
    with pytest.raises(ValueError, match="required 70 markers, got 2"):
        model(Markers(GRID[:2], GRID[:2], np.zeros(2, np.uint8), np.zeros(2)))
    with pytest.raises(ValueError, match="required a uint8 mask"):
        field_of(markers(waves(GRID))).motion(np.zeros((400, 300)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="required a size"):
        FieldModel(GRID, (0, 10))
