"""The faults of the simulated camera, and that they are noticed."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.sim import open_scene
from tactflow.tools.doctor import observe
from tactflow.vision.change import DamageTest, shows_gel


@pytest.mark.parametrize(("first", "shows"), [("black", False), ("green", False), ("leftover", True)])
def test_the_first_pictures_are_repeated_buffers(first: str, shows: bool) -> None:
    scene, whole = open_scene(f"press?frames=12&first={first}&late=2"), open_scene("press?frames=12")
    assert np.array_equal(scene.frame(0), scene.frame(1))
    assert shows_gel(scene.frame(0)) is shows
    assert not np.array_equal(scene.frame(1), whole.frame(1))
    assert np.array_equal(scene.frame(2), whole.frame(2))


def test_exposure_settles_within_the_first_pictures() -> None:
    scene = open_scene("idle?frames=12&first=exposure&late=4")
    levels = [float(scene.frame(index).mean()) for index in range(6)]
    assert levels[0] > levels[1] > levels[2] > levels[3] > levels[4]
    assert levels[4] == pytest.approx(levels[5], rel=0.01)


def test_damaged_pictures_come_regularly_and_are_noticed() -> None:
    scene = open_scene("idle?frames=24&damaged=6")
    test = DamageTest(scene.frame(0))
    assert [index for index in range(24) if test.is_damaged(scene.frame(index))] == [5, 11, 17, 23]


def test_the_doctor_counts_damaged_pictures_and_those_of_no_gel() -> None:
    course = observe("sim:idle?frames=24&damaged=6&first=black", 10.0).recorded.course
    assert (course.damaged.count, course.empty.count) == (4, 3)
