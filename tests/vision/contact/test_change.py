"""What the network sees of a frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.contact.change import CELLS, PLANES, Untouched, grid_size
from tactflow.vision.types import Markers, MarkerStatus

Image = NDArray[np.uint8]


def _gel(seed: int, shape: tuple[int, int] = (120, 160), level: float = 120.0) -> Image:
    noise = np.random.default_rng(seed).normal(level, 2, (*shape, 3))
    return np.clip(np.rint(noise), 0, 255).astype(np.uint8)


def _markers(shift: tuple[float, float], status: int = MarkerStatus.TRACKED) -> Markers:
    origin = np.array([[x, y] for y in range(10, 120, 20) for x in range(10, 160, 20)], float)
    count = len(origin)
    return Markers(origin, origin + shift, np.full(count, status, np.uint8), np.full(count, 0.02))


@pytest.mark.parametrize("shape", [(120, 160), (480, 640), (64, 48), (224, 224), (30, 300)])
def test_a_picture_of_any_size_has_as_many_cells_along_its_longer_side(shape: tuple[int, int]) -> None:
    high, wide = grid_size(shape)
    assert max(high, wide) == CELLS
    assert high / wide == pytest.approx(shape[0] / shape[1], abs=0.01)
    planes = Untouched(_gel(0, shape)).change(_gel(1, shape)).planes
    assert planes.shape[0] == PLANES
    assert all(side % 16 == 0 for side in planes.shape[1:])
    assert not planes[:, high:].any()
    assert not planes[:, :, wide:].any()


def test_noise_alone_is_a_small_change_and_a_press_a_large_one() -> None:
    untouched = Untouched(_gel(0))
    assert untouched.change(_gel(1)).strength < 4
    pressed = _gel(1)
    pressed[40:80, 60:100] += 30
    assert untouched.change(pressed).strength > 6


def test_exposure_is_taken_out() -> None:
    untouched = Untouched(_gel(0))
    assert untouched.change(_gel(1, level=140)).strength < 4


def test_a_change_reads_alike_whatever_its_contrast() -> None:
    planes = []
    for contrast in (40, 80):
        pressed = _gel(1)
        pressed[40:80, 60:100] += contrast
        planes.append(Untouched(_gel(0)).change(pressed).planes[3:6, 44:76, 64:96].mean())
    assert planes[0] == pytest.approx(planes[1], rel=0.05)


def test_the_mean_of_several_frames_has_less_noise() -> None:
    one, many = Untouched(_gel(0)), Untouched(_gel(0))
    for seed in range(2, 20):
        many.add(_gel(seed))
    assert many.change(_gel(1)).noise < 0.85 * one.change(_gel(1)).noise


def test_the_planes_say_where_dots_are_and_how_they_moved() -> None:
    hidden = np.zeros((120, 160), np.uint8)
    hidden[50:70, 50:70] = 255
    change = Untouched(_gel(0)).change(_gel(1), hidden, _markers((2.0, -1.0)))
    assert change.planes[6, 48, 48] == 1
    assert change.planes[6, 10, 10] == 0
    along, across, _, known = change.planes[8:12, 48, 64]
    assert known > 0.9
    assert across / along == pytest.approx(-0.5, abs=0.01)


@pytest.mark.parametrize("status", [MarkerStatus.INFERRED, MarkerStatus.LOST])
def test_dots_that_are_not_seen_say_nothing(status: MarkerStatus) -> None:
    change = Untouched(_gel(0)).change(_gel(1), None, _markers((2.0, -1.0), status))
    assert not change.planes[8:12].any()
