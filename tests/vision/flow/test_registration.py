"""Registration of the picture of a contact: motions, and what is not known of them."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from tactflow.vision.arrays import Floats, Floats32, Mask
from tactflow.vision.flow.registration import CELL_PX, Registration, register, template_of

REST, SPREAD = np.zeros(5), np.array([5.0, 5.0, 5.0, 1.0, 0.3])
SIZE = 60
"""Cells of each side of a picture."""


def change(
    picture: Floats32, seed: int, turn: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)
) -> Floats32:
    """(60, 60, 4): a picture that has moved about its middle, with noise of 0.3 grey levels."""
    matrix = cv2.getRotationMatrix2D(((SIZE - 1) / 2, (SIZE - 1) / 2), -math.degrees(turn), 1)
    matrix[:, 2] += shift
    moved = cv2.warpAffine(picture, matrix, (SIZE, SIZE), flags=cv2.INTER_CUBIC)
    light = np.stack([moved, 0.5 * moved, 0.8 * moved], axis=-1)
    light += np.random.default_rng(seed).normal(0, 0.3, light.shape).astype(np.float32)
    return np.dstack([light, np.ones((SIZE, SIZE), np.float32)]).astype(np.float32)


def mask_of(picture: Floats32) -> Mask:
    cells = np.where(picture > 5, 255, 0).astype(np.uint8)
    return np.asarray(
        cv2.resize(cells, None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_NEAREST), np.uint8
    )


def moved(
    picture: Floats32, seed: int = 1, turn: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)
) -> Registration:
    template = template_of(change(picture, 0), mask_of(picture))
    return register(template, change(picture, seed, turn, shift), REST, REST, SPREAD)


def stderr(found: Registration) -> Floats:
    return np.asarray(np.sqrt(np.diag(found.covariance)))


X, Y = np.meshgrid(np.arange(SIZE) - (SIZE - 1) / 2, np.arange(SIZE) - (SIZE - 1) / 2)
TEXTURE = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 1, (SIZE, SIZE)), None, 2.0)
COIN: Floats32 = np.asarray(
    cv2.GaussianBlur(np.float32((np.hypot(X, Y) < 15) * (40 + 150 * TEXTURE)), None, 1.0), np.float32
)
BALL = np.float32(40 * np.exp(-(X**2 + Y**2) / 100))


def cable(angle: float) -> Floats32:
    """From border to border, brighter towards one end; angle : from +y to +x, radians."""
    across, along = X * math.cos(angle) - Y * math.sin(angle), X * math.sin(angle) + Y * math.cos(angle)
    return np.float32(40 * np.exp(-(across**2) / 10) * (1 + 0.01 * along))


@pytest.mark.parametrize(("turn", "shift"), [(0.0, (2.3, -1.4)), (0.2, (0.0, 0.0)), (0.15, (1.0, 2.0))])
def test_a_picture_with_texture_shows_how_it_has_shifted_and_turned(
    turn: float, shift: tuple[float, float]
) -> None:
    found = moved(COIN, turn=turn, shift=shift)
    np.testing.assert_allclose(found.motion[:2], shift, atol=0.15)
    template = template_of(change(COIN, 0), mask_of(COIN))
    assert found.motion[2] / template.radius == pytest.approx(turn, abs=0.01)
    assert stderr(found)[:4].max() < 0.3


def test_a_smooth_ball_shows_its_shift_but_not_its_turn() -> None:
    found = moved(BALL, shift=(1.5, 0.5))
    np.testing.assert_allclose(found.motion[:2], (1.5, 0.5), atol=0.3)
    assert stderr(found)[:2].max() < 0.5
    assert stderr(found)[2] > 1.0


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi / 2])
def test_a_straight_cable_does_not_show_how_far_it_has_slid_along_itself(angle: float) -> None:
    covariance = moved(cable(angle)).covariance[:2, :2]
    along = np.array([math.sin(angle), math.cos(angle)])
    across = np.array([along[1], -along[0]])
    assert across @ covariance @ across < 0.3**2
    assert along @ covariance @ along > 2.0**2


def test_the_direction_that_is_not_known_turns_with_the_object() -> None:
    template = template_of(change(cable(0), 0), mask_of(cable(0)))
    turned = np.array([0.0, 0.0, 0.6 * template.radius, 0.0, 0.0])
    found = register(template, change(cable(-0.6), 1), turned, turned, SPREAD)
    along = np.array([-math.sin(0.6), math.cos(0.6)])
    covariance = found.covariance[:2, :2]
    assert along @ covariance @ along > 10 * np.linalg.det(covariance) / (along @ covariance @ along)


def test_stated_errors_are_those_of_many_pictures() -> None:
    shift = (1.3, -0.8)
    misses = []
    for seed in range(1, 60):
        noisy = template_of(change(COIN, 1000 + seed), mask_of(COIN))
        found = register(noisy, change(COIN, seed, shift=shift), REST, REST, SPREAD)
        misses.append((found.motion[:2] - shift) / stderr(found)[:2])
    # Stated ones allow for lamps that are less even than these.
    assert 0.1 < np.sqrt(np.mean(np.square(misses))) < 1.2


def test_another_picture_and_too_small_a_contact_are_not_registered() -> None:
    template = template_of(change(COIN, 0), mask_of(COIN))
    assert register(template, change(np.float32(COIN[::-1]), 1), REST, REST, SPREAD) is None
    hidden = change(COIN, 1)
    hidden[:, :33, 3] = 0
    assert register(template, hidden, REST, REST, SPREAD) is None
    dot = np.float32(40 * (np.hypot(X, Y) < 0.5))
    assert template_of(change(dot, 0), mask_of(dot)) is None
