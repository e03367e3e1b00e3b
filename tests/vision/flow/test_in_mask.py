"""Flow of the markers inside the contact."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactflow.vision.flow import flow_in_mask, inside_mask
from tactflow.vision.types import Flow, Markers, MarkerStatus

GRID = np.stack(np.meshgrid(np.arange(10, 200, 15.0), np.arange(10, 160, 15.0)), axis=-1).reshape(-1, 2)
EVERYWHERE = np.full((160, 200), 255, np.uint8)


def markers(position: NDArray[Any], origin: NDArray[Any] = GRID, status: Any = None) -> Markers:
    count = len(origin)
    known = np.zeros(count, np.uint8) if status is None else np.asarray(status, np.uint8)
    return Markers(origin, np.asarray(position), known, np.full(count, 0.02))


def moved(angle: float = 0.0, scale: float = 1.0, shift: Any = (0.0, 0.0), about: Any = (95, 77)) -> Markers:
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
    given = moved(angle, scale, (3.0, -2.0))
    flow = flow_in_mask(given, EVERYWHERE, dilate=400)
    assert flow.rotation == pytest.approx(angle, abs=1e-9)
    assert flow.divergence == pytest.approx(scale**2 - 1, abs=1e-12)
    assert flow.residual == pytest.approx(0, abs=1e-10)


def test_a_turn_to_the_left_is_positive() -> None:
    # On the screen the right end goes up (y shrinks), the left end down.
    origin = np.array([[0.0, 50], [100, 50], [50, 0], [50, 100]])
    position = np.array([[0.0, 55], [100, 45], [45, 0], [55, 100]])
    flow = flow_in_mask(markers(position, origin), EVERYWHERE, dilate=5)
    assert flow.rotation == pytest.approx(math.degrees(math.atan2(5, 50)), abs=1e-9)


def test_the_standard_error_is_the_scatter_of_the_mean() -> None:
    rng = np.random.default_rng(0)
    means, errors, residuals = [], [], []
    clean = moved(2.0, 1.02, (0.5, 0.5))
    for _ in range(300):
        noisy = markers(clean.position + rng.normal(0, [0.1, 0.3], GRID.shape))
        flow = flow_in_mask(noisy, EVERYWHERE, dilate=50)
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
    flow = flow_in_mask(markers(position, status=status), EVERYWHERE, dilate=30)
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


def test_no_contact_has_no_flow() -> None:
    assert flow_in_mask(moved(), np.zeros((160, 200), np.uint8), dilate=5) == Flow(None, 0)
    assert flow_in_mask(moved(), np.zeros((0, 0), np.uint8)) == Flow(None, 0)


def test_coordinates_far_from_the_origin_lose_no_precision() -> None:
    near = moved(3.0, 1.01, (0.5, 0.25))
    shift = np.array([50_000.0, 30_000.0])
    far = markers(near.position + shift, GRID + shift)
    # A huge mask would be needed; dilation by distance reaches the far grid from a small one.
    first = flow_in_mask(near, EVERYWHERE, dilate=70_000)
    second = flow_in_mask(far, EVERYWHERE, dilate=70_000)
    assert second.count == first.count == len(GRID)
    # Coordinates of 5e4 are rounded to 7e-12 px.
    assert second.mean == pytest.approx(first.mean, abs=1e-10)
    assert second.rotation == pytest.approx(first.rotation, abs=1e-9)


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    dilate=st.one_of(st.just(0.0), st.floats(0, 12)),
)
@example(seed=0, size=(25, 27), dilate=math.nextafter(2.0, 0.0))
def test_inside_is_the_same_as_looking_up_the_distance(
    seed: int, size: tuple[int, int], dilate: float
) -> None:
    rng = np.random.default_rng(seed)
    mask = (rng.random(size) < 0.02).astype(np.uint8) * 255
    points = rng.uniform(-15, 55, (40, 2))
    rows, columns = np.nonzero(mask)
    expected = np.zeros(40, bool)
    for k, (x, y) in enumerate(np.rint(points)):
        squared = (columns - x) ** 2 + (rows - y) ** 2
        expected[k] = bool(len(squared)) and squared.min() <= dilate**2 + 1e-9
    np.testing.assert_array_equal(inside_mask(points, mask, dilate), expected)


@pytest.mark.parametrize(
    ("mask", "dilate", "message"),
    [
        (np.zeros((3, 3), bool), 0.0, "uint8"),
        (np.zeros((3, 3, 1), np.uint8), 0.0, r"\(H, W\)"),
        (EVERYWHERE, -1.0, "dilate"),
    ],
)
def test_bad_input_is_refused_with_a_reason(mask: Any, dilate: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        flow_in_mask(moved(), mask, dilate=dilate)
