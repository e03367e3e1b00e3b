"""Poses of analytic objects whose motion is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.flow import FieldModel
from tactflow.vision.pose.rigid import inverse, rigid, vector
from tactflow.vision.pose.tracker import PoseTracker
from tactflow.vision.types import Depth, Markers, Pose, Scale

MM = 0.05
SIZE = 200
SCALE = Scale(MM, MM, (0.0, 0.0), ((SIZE - 1) / 2, (SIZE - 1) / 2))
AXIS = (np.arange(SIZE) - (SIZE - 1) / 2) * MM
X, Y = np.meshgrid(AXIS, AXIS)
RADIUS, DEEP = 4.0, 0.6
GRID = np.stack(np.meshgrid(np.arange(10.0, 200, 15), np.arange(10.0, 200, 15)), -1).reshape(-1, 2)
MODEL = FieldModel(GRID, (SIZE, SIZE))

Motion = NDArray[np.float64]
STILL = np.eye(4)


def small(*parts: float) -> Motion:
    """(4, 4) of mm and degrees."""
    return rigid(np.array([*parts[:3], *np.radians(parts[3:])]))


def pressed(motion: Motion, relief: float, seed: float = 0.0) -> tuple[Depth, NDArray[np.uint8]]:
    """A ball with `relief` mm of bumps after a motion about the middle of the untouched surface."""
    center = motion[:3, :3] @ [0, 0, RADIUS - DEEP] + motion[:3, 3]
    below = np.sqrt(np.maximum(RADIUS**2 - (X - center[0]) ** 2 - (Y - center[1]) ** 2, 0))
    for _ in range(4):
        outward = np.stack([X - center[0], Y - center[1], -below], -1) / RADIUS
        own = outward @ motion[:3, :3]
        bumps = np.sin(19 * own[..., 0] + seed) * np.sin(17 * own[..., 1] + 1 + seed * own[..., 0])
        radius = RADIUS + relief * bumps
        below = np.sqrt(np.maximum(radius**2 - (X - center[0]) ** 2 - (Y - center[1]) ** 2, 0))
    heights = np.maximum(below - center[2], 0).astype(np.float32)
    mask = np.where(heights > 0, 255, 0).astype(np.uint8)
    return Depth(heights, float(heights.max()), 0.01 * float(heights.max()), 1.0, None), mask


def gel(moved: tuple[float, float]) -> Any:
    """The gel, moved as a whole, mm."""
    position = GRID + np.array(moved) / MM
    return MODEL(Markers(GRID, position, np.zeros(len(GRID), np.uint8), np.full(len(GRID), 0.02)))


def track(motions: list[Motion], relief: float, field: Any = None, slipping: bool = False) -> Pose:
    tracker = PoseTracker(SCALE)
    for seq, motion in enumerate(motions):
        pose = tracker(seq, *pressed(motion, relief), field, slipping and seq > 0)
    assert (pose.status, pose.since) == ("tracked", 0)
    return pose


def off(pose: Pose, motion: Motion) -> NDArray[np.float64]:
    """(6,): errors, mm and degrees."""
    to_center = small(*pose.center, 0, 0, 0)
    true = inverse(to_center) @ motion @ to_center
    found = small(*pose.translation, *pose.rotation)
    away = vector(inverse(found) @ true)
    return np.concatenate([away[:3], np.degrees(away[3:])])


@pytest.mark.parametrize(
    "motion",
    [small(0.2, -0.1, 0.05, 0, 0, 0), small(0, 0, 0, 0, 0, 8), small(0.1, 0, 0, 3, -2, 4)],
    ids=["shifted", "turned", "tilted"],
)
def test_a_rough_object_is_followed_in_all_six_numbers(motion: Motion) -> None:
    steps = [rigid(part * vector(motion)) for part in np.linspace(0, 1, 6)]
    pose = track(steps, relief=0.02)
    error = off(pose, steps[-1])
    assert np.abs(error[:3]).max() < 0.02
    assert np.abs(error[3:]).max() < 0.3
    assert (np.abs(error) < 4 * np.array(pose.stderr)).all()


def test_errors_do_not_grow_while_one_keyframe_lasts() -> None:
    turned = [small(0, 0, 0, 0, 0, 6 * np.sin(seq / 10)) for seq in range(100)]
    error = off(track(turned, relief=0.02), turned[-1])
    assert np.abs(error[:3]).max() < 0.02
    assert np.abs(error[3:]).max() < 0.5


def ball_moved(pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How the middle of the ball has moved along the gel (2,), mm, and its standard errors."""
    up = RADIUS - DEEP - pose.center[2]
    by = np.eye(6)[:2]
    by[0, 4], by[1, 3] = np.radians(up), -np.radians(up)
    return by @ [*pose.translation, *pose.rotation], np.sqrt(np.diag(by @ pose.covariance @ by.T))


def test_of_a_smooth_ball_normals_see_where_it_is_and_say_that_they_do_not_see_how_it_turns() -> None:
    pose = track([STILL, small(0.15, 0, 0, 0, 0, 0)], relief=0.0)
    moved, stderr = ball_moved(pose)
    np.testing.assert_allclose(moved, [0.15, 0], atol=0.01)
    # Across the motion, a turn about the normal adds to it: the ball is not where it was.
    assert stderr[0] < 0.05
    assert stderr[1] < 0.15
    assert pose.translation[2] == pytest.approx(0, abs=0.01)
    assert pose.stderr[2] < 0.1
    assert min(pose.stderr[3:]) > 40


def rolled(way: float) -> Motion:
    """A ball that has rolled along x, mm."""
    turn = np.degrees(way / (RADIUS - DEEP / 2))
    about = small(0, 0, RADIUS - DEEP, 0, 0, 0)
    return small(way, 0, 0, 0, 0, 0) @ about @ small(0, 0, 0, 0, turn, 0) @ inverse(about)


def test_gel_that_stays_shows_that_a_smooth_ball_rolls() -> None:
    way = [rolled(x) for x in np.linspace(0, 2.5, 26)]
    pose = track(way, relief=0.0, field=gel((0, 0)))
    assert pose.rotation[1] == pytest.approx(np.degrees(2.5 / (RADIUS - DEEP / 2)), rel=0.04)
    assert np.abs(off(pose, way[-1])[:3]).max() < 0.1
    assert max(pose.stderr[3:]) < 5


def test_gel_that_moves_along_shows_that_a_smooth_ball_drags_it() -> None:
    pose = track([STILL], relief=0.0)
    tracker = PoseTracker(SCALE)
    tracker(0, *pressed(STILL, 0.0), gel((0, 0)))
    pose_now = tracker(1, *pressed(small(0.2, 0, 0, 0, 0, 0), 0.0), gel((0.2, 0)))
    assert pose_now.translation[0] == pytest.approx(0.2, abs=0.01)
    assert abs(pose_now.rotation[1]) < 0.5
    assert pose.translation == (0, 0, 0)


def test_normals_that_contradict_the_gel_are_believed() -> None:
    way = [small(x, 0, 0, 0, 0, 0) for x in np.linspace(0, 0.6, 7)]
    pose = track(way, relief=0.04, field=gel((0, 0)))
    assert np.abs(off(pose, way[-1])[:3]).max() < 0.03


def test_gel_that_slips_is_not_believed() -> None:
    pose = track([STILL, small(0.15, 0, 0, 0, 0, 0)], relief=0.0, field=gel((0, 0)), slipping=True)
    np.testing.assert_allclose(ball_moved(pose)[0], [0.15, 0], atol=0.01)
    assert min(pose.stderr[3:]) > 40


def test_the_keyframe_is_replaced_on_the_way_and_errors_add_up() -> None:
    way = [rolled(x) for x in np.linspace(0, 3, 31)]
    pose = track(way, relief=0.02)
    error = off(pose, way[-1])
    assert np.abs(error[:3]).max() < 0.1
    assert np.abs(error[3:]).max() < 1.5
    first = track(way[:3], relief=0.02)
    assert pose.stderr[5] > 2 * first.stderr[5]


def test_another_object_is_lost_and_starts_anew() -> None:
    tracker = PoseTracker(SCALE)
    tracker(4, *pressed(STILL, 0.05))
    lost = tracker(5, *pressed(small(2.5, 2.5, 0, 0, 0, 0), 0.05, seed=2.0))
    assert (lost.status, lost.since) == ("lost", 4)
    assert min(lost.stderr[3:]) > 50
    again = tracker(6, *pressed(small(2.5, 2.5, 0, 0, 0, 0), 0.05, seed=2.0))
    assert (again.status, again.since, again.translation) == ("tracked", 6, (0, 0, 0))


def test_the_error_of_the_scale_counts_along_the_gel() -> None:
    way = [small(0, 0, 0, 0, 0, 0), small(0.3, 0, 0, 0, 0, 0)]
    sure = track(way, relief=0.02)
    tracker = PoseTracker(Scale(MM, MM, (0.2 * MM, 0.2 * MM), SCALE.origin))
    for seq, motion in enumerate(way):
        unsure = tracker(seq, *pressed(motion, 0.02))
    assert unsure.stderr[0] == pytest.approx(np.hypot(sure.stderr[0], 0.2 * 0.3), rel=0.05)
    assert unsure.stderr[1] == pytest.approx(sure.stderr[1], rel=0.1)


def test_a_contact_of_a_few_pixels_has_no_pose_and_is_forgotten() -> None:
    tracker = PoseTracker(SCALE)
    tracker(0, *pressed(STILL, 0.02))
    depth, mask = pressed(STILL, 0.02)
    tiny = np.zeros_like(mask)
    tiny[90:100, 90:100] = 255
    assert tracker(1, depth, tiny) is None
    assert tracker(2, depth, np.zeros_like(mask)) is None
    pose = tracker(3, depth, mask)
    assert pose.since == 3
