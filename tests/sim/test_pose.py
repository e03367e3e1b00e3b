"""The true pose of an indenter, and its picture, agree."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

import tactflow
from tactflow.sim import shapes
from tactflow.vision.geometry import Preprocessor

TURN = np.asarray(cv2.Rodrigues(np.array([0.05, -0.04, 0.1]))[0], np.float64)


@pytest.mark.parametrize("make", [shapes.bumpy_ball, shapes.coin, shapes.ball])
def test_a_rotated_shape_has_the_rotated_points_of_the_shape(make: Callable[[], shapes.Shape]) -> None:
    shape = make()
    x, y = np.meshgrid(np.arange(-40, 41, 4, dtype=np.float32), np.arange(-40, 41, 4, dtype=np.float32))
    points = np.stack([x, y, shape.gap(x, y) - shape.center], axis=-1).reshape(-1, 3) @ TURN.T
    px, py, height = points.T.astype(np.float32)
    gap = shape.rotated(TURN).gap(px.reshape(x.shape), py.reshape(x.shape)).ravel()
    assert np.abs(gap - shape.center - height).max() < 0.05


def test_the_true_pose_is_in_the_axes_of_the_processed_picture() -> None:
    scene = tactflow.open_scene("rock?frames=200")
    first, later = 35, 55
    raw = [scene.truth(index).pose for index in (first, later)]
    mapping = Preprocessor((800, 600), rotate=90, downsample=2).mapping
    turned = [scene.truth(index, mapping).pose for index in (first, later)]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for pose, other in zip(raw, turned, strict=True):
        assert pose is not None
        assert other is not None
        np.testing.assert_allclose(other[0], quarter @ pose[0] @ quarter.T, atol=1e-9)
        np.testing.assert_allclose(other[1], quarter @ pose[1], atol=0.03)
    assert scene.truth(0).pose is None


def test_a_ball_rolls_without_slip() -> None:
    scene = tactflow.open_scene("tumble?frames=200")
    first, later = (scene.truth(index).pose for index in (35, 45))
    assert first is not None
    assert later is not None
    way = later[1] - first[1]
    turn = cv2.Rodrigues(later[0] @ first[0].T)[0].ravel()
    # The surface in contact stays where it is: somewhat less than a radius of 2.375 mm towards the camera.
    below = np.cross(turn, way) / (turn @ turn)
    assert below[2] == pytest.approx(-2.2, abs=0.1)
