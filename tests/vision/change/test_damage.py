"""Pictures that show no gel, and pictures damaged on their way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene
from tactflow.vision.change import DamageTest, shows_gel
from tactflow.vision.change.damage import MAX_DISPLACED_PICTURES

Picture = NDArray[np.uint8]

RNG = np.random.default_rng(5)


def uniform(colour: int | tuple[int, int, int]) -> Picture:
    """A picture of one colour."""
    return np.full((600, 800, 3), colour, np.uint8)


def lower(picture: Picture, values: Picture | int, begin: int = 300) -> Picture:
    """The picture with other values from a row on."""
    cut = picture.copy()
    cut[begin:] = values if isinstance(values, int) else values[begin:]
    return cut


def noise(picture: Picture) -> Picture:
    """Random bytes of the same shape."""
    return RNG.integers(0, 256, picture.shape, np.uint8)


def combed(picture: Picture) -> Picture:
    """Every other pair of rows displaced by 8 px."""
    cut = picture.copy()
    for row in (0, 1):
        cut[row::4] = np.roll(picture[row::4], 8, axis=1)
    return cut


DAMAGES: dict[str, Callable[[Picture], Picture]] = {
    "lower half gray": lambda picture: lower(picture, 128),
    "last tenth gray": lambda picture: lower(picture, 128, 540),
    "lower half black": lambda picture: lower(picture, 0),
    "empty YUV buffer": lambda _: uniform((0, 135, 0)),
    "black": lambda _: uniform(0),
    "noise": noise,
    "lower half noise": lambda picture: lower(picture, noise(picture)),
    "rows displaced": lambda picture: np.roll(picture, 8, axis=1),
    "lower half displaced": lambda picture: lower(picture, np.roll(picture, -8, axis=1)),
    "rows displaced in turns": combed,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_picture_damaged_at_rest_is_noticed_and_the_next_whole_one_is_not(damage: str) -> None:
    scene = open_scene("press?frames=60")
    test = DamageTest(scene.frame(0))
    assert test.is_damaged(DAMAGES[damage](scene.frame(1)))
    assert not test.is_damaged(scene.frame(2))


@pytest.mark.parametrize("damage", [name for name in DAMAGES if "displaced" not in name])
def test_damage_during_a_contact_is_noticed(damage: str) -> None:
    scene = open_scene("press?frames=60")
    test = DamageTest(scene.frame(0))
    assert scene.truth(30).touching
    assert not test.is_damaged(scene.frame(30))
    assert test.is_damaged(DAMAGES[damage](scene.frame(31)))


@pytest.mark.parametrize("scene", ["tap", "block", "strong_shear", "jumps", "flicker", "lamp", "noisy"])
def test_contacts_motion_and_light_are_no_damage(scene: str) -> None:
    opened = open_scene(f"{scene}?frames=60")
    test = DamageTest(opened.frame(0))
    assert not any(test.is_damaged(opened.frame(index)) for index in range(1, 60, 3))


def test_a_displacement_that_lasts_is_how_the_camera_delivers_its_pictures() -> None:
    scene = open_scene("idle?frames=2")
    test = DamageTest(scene.frame(0))
    moved = np.roll(scene.frame(1), 8, axis=1)
    assert [test.is_damaged(moved) for _ in range(MAX_DISPLACED_PICTURES + 3)] == [
        *[True] * (MAX_DISPLACED_PICTURES - 1),
        *[False] * 4,
    ]


def test_an_empty_buffer_is_damaged_however_long_it_lasts() -> None:
    test = DamageTest(open_scene("idle?frames=2").frame(0))
    assert all(test.is_damaged(uniform(0)) for _ in range(2 * MAX_DISPLACED_PICTURES))


def test_nothing_is_damaged_where_the_reference_shows_nothing() -> None:
    test = DamageTest(uniform(90))
    assert not test.is_damaged(uniform(0))


@pytest.mark.parametrize(
    ("picture", "shows"),
    [
        (uniform(0), False),
        (uniform((0, 135, 0)), False),
        (np.clip(RNG.normal(2, 2, (600, 800, 3)), 0, 255).astype(np.uint8), False),
        (open_scene("idle?frames=1").frame(0), True),
        (open_scene("unmarked?frames=1&noise=0&texture=0").frame(0), True),
        (lower(open_scene("idle?frames=1").frame(0), 128), True),
        (np.repeat(np.arange(60, dtype=np.uint8), 240).reshape(60, 80, 3), True),
    ],
    ids=["black", "green", "black with noise", "gel", "gel without noise", "half", "gradient down"],
)
def test_a_picture_without_structure_shows_no_gel(picture: Picture, shows: bool) -> None:
    assert shows_gel(picture) is shows


def test_a_picture_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="required a picture of shape"):
        DamageTest(uniform(0)).is_damaged(np.zeros((4, 4, 3), np.uint8))
