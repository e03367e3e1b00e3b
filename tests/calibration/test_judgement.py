"""What is accepted as presses of a ball, by their outlines and by how the slope grows."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tactflow.calibration.judgement import check_growth, check_presses
from tactflow.calibration.presses import Press, Session
from tactflow.engine.errors import ConfigError
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Scale

SIZE = (320, 240)
Y, X = np.mgrid[: SIZE[1], : SIZE[0]]
SQUARE = Scale(0.06, 0.06, (0.0, 0.0), (0.0, 0.0))
GEL = np.full((SIZE[1], SIZE[0], 3), 100, np.uint8)


def press(number: int, across: float, down: float, turn: float = 0.0, hole: float = 0.0) -> Press:
    """A contact with such half axes, px, turned by some degrees, maybe with a round hole."""
    middle = 60.0 + 40 * (number % 6), 60.0 + 40 * (number % 4)
    angle = np.radians(turn)
    x, y = X - middle[0], Y - middle[1]
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    inside = ((u / across) ** 2 + (v / down) ** 2 < 1) & (np.hypot(x, y) >= hole)
    mask = np.where(inside, 255, 0).astype(np.uint8)
    radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
    return Press(number, GEL, mask, np.zeros(mask.shape, np.bool_), middle, radius)


def judge(presses: list[Press], scale: Scale = SQUARE, ball_radius: float = 2.0) -> str | None:
    """What `calibrate` says before it fits; None if it goes on."""
    session = Session(GEL, PixelMapping.identity(SIZE), presses, np.zeros((0, 2)), 100)
    try:
        check_presses(session, scale, np.full(len(presses), ball_radius))
    except ConfigError as problem:
        return str(problem)
    return None


def test_outlines_that_are_as_round_as_those_of_balls_on_real_gels_are_accepted() -> None:
    # Lights from one side lengthen single outlines by a quarter.
    shapes = [(30.0, 30.0 * (1.0, 1.12, 1.25)[n % 3]) for n in range(12)]
    assert judge([press(n, *axes, turn=37.0 * n) for n, axes in enumerate(shapes)]) is None


@pytest.mark.parametrize(
    ("axes", "turn", "hole", "words"),
    [
        ((36.0, 25.0), 40.0, 0.0, "1.44 times as long as wide"),
        ((33.0, 27.0), 0.0, 0.0, "1.22 times as long in one direction of the picture"),
        ((30.0, 30.0), 0.0, 20.0, "fill 39 % of their outline"),
        ((56.0, 56.0), 0.0, 0.0, "give its radius, not its diameter"),
    ],
    ids=["ellipsoid", "stretched", "ring", "too large"],
)
def test_what_has_no_outline_of_a_ball_is_refused_with_what_was_found(
    axes: tuple[float, float], turn: float, hole: float, words: str
) -> None:
    problem = judge([press(n, *axes, turn=turn * n, hole=hole) for n in range(12)], ball_radius=1.9)
    assert problem is not None
    assert re.search(words, problem)


@pytest.mark.parametrize("count", [1, 12])
def test_a_swapped_area_is_refused_and_named_whatever_the_number_of_presses(count: int) -> None:
    swapped = Scale(SQUARE.x * 3 / 4, SQUARE.y * 4 / 3, (0.0, 0.0), (0.0, 0.0))
    problem = judge([press(n, 30.0, 30.0) for n in range(count)], swapped)
    assert problem is not None
    assert "1.78 times" in problem
    assert "--area WIDTH HEIGHT in this order" in problem


def test_outlines_that_the_border_cuts_off_do_not_count() -> None:
    cut = [press(n, 30.0, 30.0) for n in range(12)]
    for one in cut[:5]:
        one.mask[:, : int(one.center[0])] = 0
        one.mask[int(one.center[1]), :] = 255
    assert judge(cut) is None


@pytest.mark.parametrize(
    ("growths", "accepted"),
    [
        ([0.74, 0.7, 0.9], True),
        ([1.0, np.nan, 1.1], True),
        ([np.nan], True),
        ([0.5, 0.4, 0.9], False),
        ([1.9, 1.5, 1.0], False),
    ],
)
def test_a_slope_that_does_not_grow_with_the_distance_is_of_no_ball(
    growths: list[float], accepted: bool
) -> None:
    if accepted:
        check_growth(np.array(growths))
        return
    with pytest.raises(ConfigError, match="pointed or flat"):
        check_growth(np.array(growths))
