"""Temporal smoothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tactflow.vision.smooth import ContactSmoother, OneEuro
from tactflow.vision.types import Contact

HULL = np.zeros((1, 2))


def contact(x: float = 0.0, y: float = 0.0, angle: float | None = 0.0) -> Contact:
    slope = None if angle is None or angle == 90 else -math.tan(math.radians(angle))
    return Contact(10.0, (x, y), angle, slope, HULL, None, 0.5, 9.0)


def turned(first: float, second: float) -> float:
    return abs((first - second + 90) % 180 - 90)


def test_one_euro_is_the_published_filter() -> None:
    values = np.cumsum(np.random.default_rng(1).normal(0, 1, 50))
    dt, min_cutoff, coefficient, speed_cutoff = 1 / 30, 1.3, 0.2, 0.9

    def alpha(cutoff: float) -> float:
        return 1 / (1 + 1 / (2 * math.pi * cutoff) / dt)

    expected, speed, last = [values[0]], 0.0, values[0]
    for value in values[1:]:
        a = alpha(speed_cutoff)
        speed = a * (value - last) / dt + (1 - a) * speed
        last = value
        a = alpha(min_cutoff + coefficient * abs(speed))
        expected.append(a * value + (1 - a) * expected[-1])
    smoother = OneEuro(min_cutoff, coefficient, speed_cutoff)
    assert [smoother.update(value, dt) for value in values] == pytest.approx(expected, abs=1e-12)


def test_an_axis_that_turns_through_the_vertical_is_smoothed_like_any_other() -> None:
    steps = np.random.default_rng(2).normal(0.5, 2, 400).cumsum()
    plain, seam = ContactSmoother(), ContactSmoother()
    for k, step in enumerate(steps):
        first = plain.update(contact(angle=_axis(step)), k / 60)
        second = seam.update(contact(angle=_axis(step + 90)), k / 60)
        assert first.angle is not None
        assert second.angle is not None
        assert -90 < second.angle <= 90
        # Turning the input turns the output; 1e-9 is rounding over 400 steps.
        assert turned(second.angle, first.angle + 90) < 1e-9


def _axis(angle: float) -> float:
    wrapped = angle - 180 * math.ceil(angle / 180 - 0.5)
    return wrapped if wrapped > -90 else 90.0


def test_plus_and_minus_89_meet_at_90_and_not_at_0() -> None:
    smoother = ContactSmoother()
    for k in range(60):
        smoothed = smoother.update(contact(angle=89.0 if k % 2 else -89.0), k / 60)
        assert smoothed.angle is not None
        assert abs(smoothed.angle) >= 88.9


def test_slope_follows_the_smoothed_angle() -> None:
    smoother = ContactSmoother()
    smoother.update(contact(angle=10), 0.0)
    smoothed = smoother.update(contact(angle=40), 0.1)
    assert smoothed.angle is not None
    assert 10 < smoothed.angle < 40
    assert smoothed.slope == pytest.approx(-math.tan(math.radians(smoothed.angle)))
    vertical = ContactSmoother().update(contact(angle=90), 0.0)
    assert vertical.angle == 90
    assert vertical.slope is None


def test_everything_else_is_left_as_measured_and_the_input_too() -> None:
    smoother = ContactSmoother()
    smoother.update(contact(), 0.0)
    given = contact(5.0, 6.0, 30.0)
    smoothed = smoother.update(given, 0.1)
    assert smoothed.hull is given.hull
    assert (smoothed.area, smoothed.confidence, smoothed.region_area) == (10.0, 0.5, 9.0)
    assert given.center == (5.0, 6.0)
    assert 0 < smoothed.center[0] < 5
    assert 0 < smoothed.center[1] < 6


def test_time_that_does_not_advance_starts_afresh() -> None:
    smoother = ContactSmoother()
    smoother.update(contact(0, 0, 0), 5.0)
    for t in (5.0, 1.0):
        assert smoother.update(contact(50, 60, 70), t).center == (50, 60)


def test_a_contact_without_direction_keeps_none_and_restarts_the_angle() -> None:
    smoother = ContactSmoother()
    smoother.update(contact(0, 0, 0), 0.0)
    gap = smoother.update(contact(10, 0, None), 0.1)
    assert gap.angle is None
    assert gap.slope is None
    assert 0 < gap.center[0] < 10
    assert smoother.update(contact(10, 0, 50), 0.2).angle == 50


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"min_cutoff": 0.0}, "min_cutoff"),
        ({"speed_coefficient": -1.0}, "speed_coefficient"),
    ],
)
def test_bad_options_are_refused_with_a_reason(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ContactSmoother(**kwargs)
