"""The noise is white, of the promised strength, and another one in every frame."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.sim import open_scene
from tactflow.sim.camera import NOISE_UNIT, sensor_noise

SHAPE = (600, 800, 3)
COUNT = 600 * 800 * 3


def frame_noise(seed: int, index: int) -> np.ndarray:
    return sensor_noise(seed, index, SHAPE).astype(np.float64) / NOISE_UNIT


@pytest.mark.parametrize(("first", "second"), [(0, 1), (0, 2), (5, 6), (10, 299), (0, 1000), (3, 99_999)])
def test_frames_are_independent_at_every_pixel_and_at_small_shifts(first: int, second: int) -> None:
    one, other = frame_noise(7, first), frame_noise(7, second)
    for dy, dx in ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0), (2, 2), (3, -3)):
        shifted = np.roll(other, (dy, dx), axis=(0, 1))
        # Derived: the standard error of a correlation is 1 / sqrt(n); five of them, over 42 tests.
        assert abs((one * shifted).mean()) < 5 * COUNT**-0.5


def test_the_difference_of_two_frames_at_rest_shows_the_noise_asked_for() -> None:
    scene = open_scene("idle?noise=3&markers=none")
    difference = scene.frame(1).astype(float) - scene.frame(2)
    # Derived: sqrt(2) x 3, plus the rounding of two frames (1/12 each).
    assert difference.std() == pytest.approx((2 * 9 + 2 / 12) ** 0.5, rel=0.005)
    assert abs(difference.mean()) < 0.02


def test_shot_noise_grows_with_the_square_root_of_the_light() -> None:
    scene = open_scene("idle?noise=0&shot=4&markers=none&texture=0")
    frames = np.stack([scene.frame(index) for index in range(10)]).astype(float)
    level, spread = frames.mean(axis=0), frames.var(axis=0, ddof=1)
    dark, bright = level < np.quantile(level, 0.1), level > np.quantile(level, 0.9)
    for part in (dark, bright):
        expected = 16 * level[part].mean() / 128 + 1 / 12
        assert spread[part].mean() == pytest.approx(
            expected, rel=0.02
        )  # 144,000 values of 9 degrees of freedom
    assert spread[bright].mean() > 1.3 * spread[dark].mean()
