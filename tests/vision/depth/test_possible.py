"""How deep a contact can be at all."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tactflow.vision.depth.possible import deepest_possible
from tactflow.vision.types import Scale

SCALE = Scale(0.1, 0.2, (0.0, 0.0), (0.0, 0.0))
Y, X = np.mgrid[:100, :160]


def mask(inside: np.ndarray) -> np.ndarray:
    """255 inside."""
    return np.where(inside, 255, 0).astype(np.uint8)


@pytest.mark.parametrize(
    ("inside", "most"),
    [
        (np.hypot((X - 80) * 0.1, (Y - 50) * 0.2) < 2, 2.0),
        ((abs(X - 80) < 40) & (abs(Y - 50) < 5), 1.0),
        (abs((X - 80) * 0.1 + (Y - 50) * 0.2) * 0.5**0.5 < 1, math.inf),
        ((X - 80) ** 2 + (Y - 99) ** 2 < 400, math.inf),
        (np.hypot((X - 80) * 0.1, (Y - 50) * 0.2) < 20, math.inf),
        (np.zeros_like(X, bool), math.inf),
    ],
    ids=["disc", "strip", "band from border to border", "cut off", "the whole picture", "nothing"],
)
def test_a_contact_is_at_most_as_deep_as_half_its_width_where_this_is_seen(
    inside: np.ndarray, most: float
) -> None:
    assert deepest_possible(mask(inside), SCALE) == pytest.approx(most, abs=0.25)
    assert deepest_possible(mask(inside), SCALE, 0.4) == 0.4


def test_pieces_count_as_one_object() -> None:
    threads = (abs(X - 80) < 30) & (abs(Y - 50) < 20) & (X % 8 < 3)
    assert deepest_possible(mask(threads), SCALE) > 2.5
