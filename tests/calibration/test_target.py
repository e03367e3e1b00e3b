"""Scale from a printed target, against the camera that has seen it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.calibration.target import Target, find_target, scale_from_target
from tactflow.vision.geometry.lens import Lens

TARGET = Target(7, 5, 2.0)
LENS = Lens(np.array([[300.0, 0, 165], [0, 305, 117], [0, 0, 1]]), np.array([-0.25, 0.08, 0, 0, 0]))
SIZE = (320, 240)
AWAY = np.array([-6.0, -4.0, 20.0])
"""Where the first point of the target is, from the camera, mm."""


def picture(turn: tuple[float, float, float], dots: bool = False) -> NDArray[np.uint8]:
    """A target as the camera sees it: each of 2 x 2 samples of a pixel asks which part of it it shows."""
    matrix = cv2.Rodrigues(np.array(turn, float))[0]
    x, y = np.meshgrid(*(np.arange(2 * side) / 2 - 0.25 for side in SIZE))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    flat = cv2.undistortPoints(points[:, None], LENS.camera_matrix, LENS.distortion)[:, 0]
    rays = np.column_stack([flat, np.ones(len(flat))]) @ matrix
    start = -AWAY @ matrix
    u, v, _ = (start - rays * (start[2] / rays[:, 2:])).T / TARGET.pitch
    margin = 0.5 if dots else 1.0
    right, low = TARGET.columns - 1 + margin, TARGET.rows - 1 + margin
    inside = (u > -margin) & (u < right) & (v > -margin) & (v < low)
    printed = np.hypot(u - np.rint(u), v - np.rint(v)) < 0.25
    dark = inside & (printed if dots else (np.floor(u) + np.floor(v)) % 2 == 0)
    grey = np.where(dark, 40, 200).astype(np.uint8).reshape(2 * SIZE[1], 2 * SIZE[0])
    return cv2.merge([cv2.resize(grey, SIZE, interpolation=cv2.INTER_AREA)] * 3)


@pytest.mark.parametrize("dots", [False, True])
def test_a_target_in_the_plane_of_the_gel_gives_the_scale_however_it_lies(dots: bool) -> None:
    target = Target(TARGET.columns, TARGET.rows, TARGET.pitch, dots)
    rectified = cv2.undistort(picture((0, 0, 0.3), dots), LENS.camera_matrix, LENS.distortion)
    points = find_target(np.asarray(rectified, np.uint8), target)
    assert points is not None
    scale, bent = scale_from_target(points, target, SIZE)
    assert scale.x == pytest.approx(20 / 300, rel=0.002)
    assert scale.y == pytest.approx(20 / 305, rel=0.002)
    assert bent < 0.01
    tilted = find_target(picture((0.5, 0, 0), dots), target)
    assert tilted is not None
    assert scale_from_target(tilted, target, SIZE)[1] > 0.02


def test_the_standard_error_of_a_scale_by_a_target_is_honest() -> None:
    rng, off = np.random.default_rng(1), []
    for _ in range(300):
        scale, _ = scale_from_target(TARGET.places * 10 + rng.normal(0, 0.3, (35, 2)), TARGET, SIZE)
        off += [(scale.x - 0.1) / scale.stderr[0], (scale.y - 0.1) / scale.stderr[1]]
    assert 0.61 <= np.mean(np.abs(off) < 1) <= 0.75
    assert 0.91 <= np.mean(np.abs(off) < 2) <= 0.99
