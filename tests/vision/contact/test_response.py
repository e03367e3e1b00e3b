"""How evenly the light answers to slopes, told from one contact."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.contact.response import LARGEST_GAIN, light_response

Float = NDArray[np.float32]

EVERYWHERE = np.ones((30, 30), np.bool_)


def bowl(wide: float, high: float, lights: list[list[float]]) -> Float:
    """(60, 180) change where a paraboloid is pressed in; lights : (3, 2), answer to each slope."""
    y, x = np.mgrid[:60, :60].astype(np.float32) - 29.5
    inside = (x / wide) ** 2 + (y / high) ** 2 < 1
    slopes = np.stack([x / wide**2, y / high**2]) * inside * (10 * min(wide, high))
    return np.asarray(np.moveaxis(slopes, 0, 2) @ np.transpose(lights), np.float32).reshape(60, 180)


def weighed(change: Float) -> Float:
    gain, strongest = light_response(change, EVERYWHERE)
    pixels = change.reshape(60, 60, 3)
    square = gain * (pixels**2).sum(axis=2) - (pixels @ strongest) ** 2
    return np.asarray(np.sqrt(np.maximum(square, 0)), np.float32)


@pytest.mark.parametrize("weak", [0.7, 0.5])
def test_slopes_that_the_light_shows_weakly_count_as_much_as_the_others(
    weak: float,
) -> None:
    shown = weighed(bowl(24, 24, [[0, weak], [1, 0], [0, 0]]))
    along_x, along_y = shown[29, 50], shown[50, 29]
    # How long a contact is where its sides are faint is not told exactly: half of the error is left at most.
    assert 1 - along_y / along_x < 0.5 * (1 - weak)


def test_what_counts_more_leaves_the_sum_as_it_is() -> None:
    change = bowl(24, 24, [[0, 0.4], [1, 0.1], [0.3, 0]])
    assert (weighed(change) ** 2).sum() == pytest.approx((change**2).sum(), rel=1e-3)


def test_an_answer_is_not_raised_beyond_the_largest_gain() -> None:
    gain, strongest = light_response(bowl(24, 24, [[0, 0.01], [1, 0], [0, 0]]), EVERYWHERE)
    along = gain - (strongest**2).sum()
    assert gain / along == pytest.approx(LARGEST_GAIN**2, rel=1e-3)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(bowl(24, 24, [[0, 1], [1, 0], [0, 0]]), id="even light"),
        pytest.param(bowl(29, 5, [[0, 1], [0.05, 0], [0, 0]]), id="an edge"),
        pytest.param(np.zeros((60, 180), np.float32), id="nothing"),
    ],
)
def test_even_light_and_long_contacts_are_left_as_they_are(change: Float) -> None:
    gain, strongest = light_response(change, EVERYWHERE)
    assert gain == pytest.approx(1, abs=1e-3)
    assert np.abs(strongest).max() < 0.05


def test_a_contact_that_grows_long_loses_the_weights_bit_by_bit() -> None:
    gains = [
        float(light_response(bowl(26, 26 / ratio, [[0, 1], [0.2, 0], [0, 0]]), EVERYWHERE).gain)
        for ratio in np.arange(1.0, 5.0, 0.02)
    ]
    assert max(gains) > 2
    assert gains[-1] == 1
    assert np.abs(np.diff(gains)).max() < 1
