"""Flow of the markers inside the contact."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.flow import flow_in_mask, inside_mask
from tactflow.vision.types import Flow, Markers, MarkerStatus

GRID = np.stack(np.meshgrid(np.arange(210, 400, 15.0), np.arange(210, 360, 15.0)), axis=-1).reshape(-1, 2)
EVERYWHERE = np.full((600, 600), 255, np.uint8)


def markers(position: NDArray[Any], origin: NDArray[Any] = GRID, status: Any = None) -> Markers:
    count = len(origin)
    known = np.zeros(count, np.uint8) if status is None else np.asarray(status, np.uint8)
    return Markers(origin, np.asarray(position), known, np.full(count, 0.02))


def moved(
    angle: float = 0.0, scale: float = 1.0, shift: Any = (0.0, 0.0), about: Any = (295, 277)
) -> Markers:
    """The grid turned by `angle` degrees counter-clockwise as seen, scaled, and shifted."""
    theta = math.radians(-angle)
    turn = scale * np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    return markers((GRID - about) @ turn.T + about + shift)


def assert_sound(flow: Flow) -> None:
    numbers = [*(flow.mean or ()), *(flow.stderr or ())]
    numbers += [value for value in (flow.rotation, flow.divergence, flow.residual) if value is not None]
    assert np.isfinite(numbers).all()
    assert (flow.mean is None) == (flow.count == 0)
    assert (flow.rotation is None) == (flow.divergence is None) == (flow.residual is None)


def test_a_shift_of_the_whole_grid_is_the_mean() -> None:
    flow = flow_in_mask(moved(shift=(1.25, -0.75)), EVERYWHERE)
    assert flow.count == len(GRID)
    assert flow.mean == pytest.approx((1.25, -0.75), abs=1e-12)
    assert flow.stderr == pytest.approx((0, 0), abs=1e-12)
    assert flow.rotation == pytest.approx(0, abs=1e-9)
    assert flow.divergence == pytest.approx(0, abs=1e-12)
    assert flow.residual == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("angle", [-170.0, -20.0, -1.0, 0.5, 7.0, 90.0])
@pytest.mark.parametrize("scale", [0.9, 1.0, 1.2])
def test_twist_and_press_are_found_exactly_at_any_size(angle: float, scale: float) -> None:
    flow = flow_in_mask(moved(angle, scale, (3.0, -2.0)), EVERYWHERE)
    assert flow.rotation == pytest.approx(angle, abs=1e-9)
    assert flow.divergence == pytest.approx(scale**2 - 1, abs=1e-12)
    assert flow.residual == pytest.approx(0, abs=1e-10)


def test_a_turn_to_the_left_is_positive() -> None:
    # On the screen the right end goes up (y shrinks), the left end down.
    origin = np.array([[0.0, 50], [100, 50], [50, 0], [50, 100]])
    position = np.array([[0.0, 55], [100, 45], [45, 0], [55, 100]])
    flow = flow_in_mask(markers(position, origin), EVERYWHERE)
    assert flow.rotation == pytest.approx(math.degrees(math.atan2(5, 50)), abs=1e-9)


def test_the_standard_error_is_the_scatter_of_the_mean() -> None:
    rng = np.random.default_rng(0)
    means, errors, residuals = [], [], []
    clean = moved(2.0, 1.02, (0.5, 0.5))
    for _ in range(300):
        noisy = markers(clean.position + rng.normal(0, [0.1, 0.3], GRID.shape))
        flow = flow_in_mask(noisy, EVERYWHERE)
        means.append(flow.mean)
        errors.append(flow.stderr)
        residuals.append(flow.residual)
    # 300 draws give a standard deviation to 4 % (one sigma): three sigma.
    ratio = np.mean(errors, axis=0) / np.std(means, axis=0)
    assert ratio == pytest.approx((1, 1), abs=0.12)
    # sqrt(0.01 + 0.09), less the four parameters that the fit took; to 0.3 % (one sigma).
    expected = math.sqrt(0.1 * (1 - 2 / len(GRID)))
    assert np.sqrt(np.mean(np.square(residuals))) == pytest.approx(expected, rel=0.015)


def test_lost_markers_do_not_count_and_inferred_ones_do() -> None:
    position = GRID + 1.0
    status = np.zeros(len(GRID), np.uint8)
    position[3] += 50
    status[3] = MarkerStatus.LOST
    position[5] += 0.5
    status[5] = MarkerStatus.INFERRED
    flow = flow_in_mask(markers(position, status=status), EVERYWHERE)
    assert flow.count == len(GRID) - 1
    assert flow.mean == pytest.approx(np.full(2, 1 + 0.5 / flow.count), abs=1e-12)


def test_the_standard_error_needs_two_tracked_markers() -> None:
    status = np.full(len(GRID), MarkerStatus.INFERRED, np.uint8)
    flow = flow_in_mask(markers(GRID + 1.0, status=status), EVERYWHERE)
    assert flow.stderr is None
    assert flow.count == len(GRID)
    status[:2] = MarkerStatus.TRACKED
    assert flow_in_mask(markers(GRID + 1.0, status=status), EVERYWHERE).stderr is not None


def test_a_single_tracked_marker_stands_alone() -> None:
    # What is inferred comes from neighbours, of which only one is in the contact.
    status = np.full(len(GRID), MarkerStatus.INFERRED, np.uint8)
    status[7] = MarkerStatus.TRACKED
    position = GRID + 1.0
    position[7] += 3.0
    flow = flow_in_mask(markers(position, status=status), EVERYWHERE)
    assert flow == Flow((4.0, 4.0), 1)


def test_the_current_position_decides_who_is_inside() -> None:
    mask = np.zeros((160, 200), np.uint8)
    mask[70:80, 90:100] = 255
    origin = np.array([[95.0, 75], [20, 20]])
    position = np.array([[20.0, 20], [95, 75]])
    flow = flow_in_mask(markers(position, origin), mask)
    assert flow.count == 1
    assert flow.mean == (75.0, 55.0)
    assert flow.stderr is None


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_markers_have_no_twist(count: int) -> None:
    flow = flow_in_mask(markers(GRID[:count] + 1.0, GRID[:count]), EVERYWHERE)
    assert_sound(flow)
    assert flow.count == count
    assert flow.rotation is None
    assert (flow.stderr is None) == (count < 2)


def test_markers_on_a_line_have_no_twist() -> None:
    origin = np.column_stack([np.arange(10.0, 60, 10), np.arange(10.0, 60, 10) * 0.5])
    flow = flow_in_mask(markers(origin + 1.0, origin), EVERYWHERE)
    assert flow.rotation is None
    assert flow.mean == pytest.approx((1, 1))
    flow = flow_in_mask(markers(np.full((5, 2), 20.0), np.full((5, 2), 20.0)), EVERYWHERE)
    assert flow.rotation is None


@pytest.mark.parametrize("shape", [(160, 200), (0, 0)])
def test_no_contact_has_no_flow(shape: tuple[int, int]) -> None:
    assert flow_in_mask(moved(), np.zeros(shape, np.uint8)) == Flow(None, 0)


def test_a_marker_is_inside_if_its_nearest_pixel_is() -> None:
    mask = np.zeros((12, 20), np.uint8)
    mask[0, 3] = mask[11, 19] = 1
    points = [[3.4, 0.4], [3.6, 0.0], [2.6, -0.4], [3.0, -0.6], [19.4, 11.4], [19.6, 11.0], [1e300, -1e300]]
    expected = [True, False, True, False, True, False, False]
    assert inside_mask(np.array(points), mask).tolist() == expected


@pytest.mark.parametrize("mask", [np.zeros((3, 3), bool), np.zeros((3, 3, 1), np.uint8)])
def test_other_masks_are_refused(mask: Any) -> None:
    with pytest.raises(ValueError, match=r"required a uint8 mask of shape \(H, W\)"):
        flow_in_mask(moved(), mask)
