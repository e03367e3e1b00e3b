"""Motion: whether the markers move as a contact moves them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.flow.motion import MotionTest
from tactflow.vision.types import Markers, MarkerStatus

ORIGIN = np.array([[x, y] for y in range(20, 220, 25) for x in range(20, 300, 25)], np.float64)
PRESSED = np.linalg.norm(ORIGIN - [147, 118], axis=1) < 40


def moved(displacement: NDArray[np.float64] | float = 0.0, *, noise: float = 0.0, seed: int = 0) -> Markers:
    wandering = np.random.default_rng(seed).normal(0, 1, ORIGIN.shape) * noise
    return Markers(
        ORIGIN, ORIGIN + displacement + wandering, np.zeros(len(ORIGIN), np.uint8), np.full(len(ORIGIN), 0.02)
    )


def press(depth: float) -> NDArray[np.float64]:
    """Markers in a disc move away from its middle."""
    away = ORIGIN - [147, 118]
    return np.asarray(depth * PRESSED[:, None] * away / np.linalg.norm(away, axis=1)[:, None])


def rotation(degrees: float) -> NDArray[np.float64]:
    angle = math.radians(degrees)
    matrix = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = np.array([200.0, 80.0])
    return np.asarray((ORIGIN - middle) @ matrix.T + middle - ORIGIN)


def test_markers_at_rest_do_not_move() -> None:
    test = MotionTest(ORIGIN)
    seen = [test(moved(noise=0.14, seed=seed)) for seed in range(2000)]
    assert not any(motion.moving for motion in seen)
    assert np.mean([motion.still().mean() for motion in seen]) > 0.8


def test_false_alarms_come_at_most_at_the_stated_rate() -> None:
    """With a rate high enough to be counted. Those that follow one are held by it."""
    rate = 0.05
    alarms = sum(
        MotionTest(ORIGIN, false_alarms=rate)(moved(noise=math.hypot(0.14, 0.02), seed=seed)).moving
        for seed in range(2000)
    )
    assert 0 < alarms <= 1.3 * rate * 2000


@pytest.mark.parametrize("depth", [1.0, 3.0, 8.0])
def test_a_press_moves_them(depth: float) -> None:
    motion = MotionTest(ORIGIN)(moved(press(depth), noise=0.1))
    assert motion.moving
    assert motion.largest == pytest.approx(depth, abs=0.4)
    assert not motion.still()[PRESSED].any()


@pytest.mark.parametrize(
    "displacement", [np.full(ORIGIN.shape, (7.0, -3.0)), rotation(0.8), rotation(-1.5) + 4.0]
)
def test_a_shift_or_a_turn_of_the_whole_gel_is_no_contact(displacement: NDArray[np.float64]) -> None:
    test = MotionTest(ORIGIN)
    assert not test(moved(displacement, noise=0.05)).moving
    assert test(moved(displacement + press(2.0), noise=0.05)).moving


def test_a_single_marker_does_not_move_alone() -> None:
    """It may have been taken for another; three neighbours are believed."""
    displacement = np.zeros(ORIGIN.shape)
    displacement[[5, 40, 70]] = 10.0
    assert not MotionTest(ORIGIN)(moved(displacement)).moving
    displacement[[41, 42]] = 2.0
    assert MotionTest(ORIGIN)(moved(displacement)).moving


@pytest.mark.parametrize("status", [MarkerStatus.INFERRED, MarkerStatus.LOST])
def test_markers_that_are_not_seen_have_no_vote(status: MarkerStatus) -> None:
    markers = moved(press(5.0))
    markers.status[PRESSED] = status
    markers.stderr[PRESSED] = np.nan
    motion = MotionTest(ORIGIN)(markers)
    assert not motion.moving
    assert not motion.still()[PRESSED].any()


def test_what_a_released_gel_still_shows_is_no_motion() -> None:
    """A tenth of the strongest recent motion; once that is forgotten, it is one."""
    test = MotionTest(ORIGIN)
    assert test(moved(press(10.0))).moving
    assert not test(moved(press(0.8))).moving
    rest = [test(moved(press(0.8))).moving for _ in range(60)]
    assert not rest[0]
    assert rest[-1]


def test_motion_that_fades_is_held_below_the_threshold_that_started_it() -> None:
    test = MotionTest(ORIGIN)
    assert not test(moved(press(0.45))).moving
    assert [test(moved(press(depth))).moving for depth in (1.0, 0.45, 0.2, 0.45)] == [
        True,
        True,
        False,
        False,
    ]


def test_motion_that_lasts_is_clear_where_a_sudden_one_of_that_size_is_not() -> None:
    """The error of a mean of n frames is smaller by the root of n; what fades is on its way to rest."""
    lasting, fading = MotionTest(ORIGIN), MotionTest(ORIGIN)
    assert [lasting(moved(press(1.0))).clearly for _ in range(5)] == [False, False, True, True, True]
    assert not any(fading(moved(press(1.4 * 0.65**step))).clearly for step in range(5))
    unsteady = [lasting(moved(press(depth))).clearly for depth in (0.0, 1.0, 0.0, 1.0)]
    assert not any(unsteady)


def test_the_most_stretched_markers_surround_the_contact() -> None:
    """In the middle of a pressed disc as well as at its rim, neighbours part."""
    test = MotionTest(ORIGIN)
    center = test.stretched(moved(press(4.0))).mean(axis=0)
    assert np.linalg.norm(center - [147, 118]) < 10


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_markers_never_move(count: int) -> None:
    origin = ORIGIN[:count]
    markers = Markers(origin, origin + 5.0, np.zeros(count, np.uint8), np.full(count, 0.02))
    assert not MotionTest(origin)(markers).moving


def test_the_markers_must_be_those_of_the_reference() -> None:
    with pytest.raises(ValueError, match="required 3 markers"):
        MotionTest(ORIGIN[:3])(moved())


@pytest.mark.parametrize(
    "values", [{"false_alarms": 0.0}, {"false_alarms": 1.0}, {"steadiness": 0.0}, {"relaxation": 1.0}]
)
def test_parameters_out_of_range_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="required"):
        MotionTest(ORIGIN, **values)


@pytest.mark.parametrize("count", [3, 4, 60, 61])
@pytest.mark.parametrize("digits", [0, 15])
def test_the_motion_of_the_whole_gel_is_taken_by_medians(count: int, digits: int) -> None:
    rng = np.random.default_rng(count)
    origin = rng.uniform(0, 300, (count, 2))
    displacement = np.round(rng.normal(0, 2, (count, 2)), digits)
    motion = MotionTest(origin)(
        Markers(origin, origin + displacement, np.zeros(count, np.uint8), np.full(count, 0.02))
    )
    arms = origin - origin.mean(axis=0)
    rest = displacement - np.median(displacement, axis=0)
    levers = arms / np.maximum((arms**2).sum(axis=1, keepdims=True), 1)
    turn = np.median(levers[:, 0] * rest[:, 1] - levers[:, 1] * rest[:, 0])
    rest -= turn * arms[:, ::-1] * [-1, 1]
    np.testing.assert_allclose(motion.left, np.hypot(*rest.T), atol=1e-9)
    assert motion.largest == pytest.approx(np.sort(motion.left)[-3])
