"""Millimetres per pixel, from a grid of dots and from corners."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from tactflow.calibration.scale import scale_from_pitch

SIZE = (300, 400)


def grid(mm_x: float, mm_y: float, pitch: float, turn: float, noise: float, seed: int) -> NDArray[np.float64]:
    """Dots of a square grid of so many mm, turned, in a picture with so many mm per pixel."""
    columns, rows = np.meshgrid(np.arange(10), np.arange(12))
    square = pitch * np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    dots = square @ np.array([[cos, sin], [-sin, cos]]) / (mm_x, mm_y)
    return dots + np.random.default_rng(seed).normal(0, noise, dots.shape)


@pytest.mark.parametrize("turn", [0.0, 4.0, -12.0])
def test_the_pitch_of_a_grid_gives_the_scale_of_both_axes(turn: float) -> None:
    scale = scale_from_pitch(grid(0.08, 0.1, 2.0, turn, 0.05, 1), 2.0, SIZE)
    assert scale.x == pytest.approx(0.08, rel=0.01)
    assert scale.y == pytest.approx(0.1, rel=0.01)
    assert scale.origin == (149.5, 199.5)


def test_the_standard_error_of_a_scale_is_honest() -> None:
    scales = [scale_from_pitch(grid(0.1, 0.1, 2.0, 0.0, 0.3, seed), 2.0, SIZE) for seed in range(100)]
    off = np.array([(scale.x - 0.1) / scale.stderr[0] for scale in scales])
    assert 0.5 < off.std() < 1.5


def rings(pitch: float, noise: float, seed: int) -> NDArray[np.float64]:
    """Dots on 8 rings, 10 px a mm: so far apart are rings, and dots along a ring."""
    random = np.random.default_rng(seed)
    dots = [[0.0, 0.0]]
    for ring in range(1, 9):
        angles = 2 * np.pi * (np.arange(6 * ring) / (6 * ring) + random.uniform())
        dots += (10 * ring * pitch * np.column_stack([np.cos(angles), np.sin(angles)])).tolist()
    return np.array(dots) + random.normal(0, noise, (len(dots), 2))


@pytest.mark.parametrize("form", ["rings", "askew", "wide"])
def test_dots_in_no_square_grid_have_the_error_that_they_make(form: str) -> None:
    off = []
    for seed in range(50):
        dots = {
            "rings": lambda seed: rings(2.0, 0.5, seed),
            "askew": lambda seed: grid(0.1, 0.1, 2.0, 45.0, 1.0, seed),
            # The columns are a twentieth further apart than the pitch says.
            "wide": lambda seed: grid(0.1, 0.1, 2.0, 0.0, 0.3, seed) * (1.05, 1.0),
        }[form](seed)
        scale = scale_from_pitch(dots, 2.0, SIZE)
        off += [(scale.x - 0.1) / scale.stderr[0], (scale.y - 0.1) / scale.stderr[1]]
    assert np.percentile(np.abs(off), 95) < 2
    assert np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_grid_at_45_degrees_gives_one_scale_for_both_axes() -> None:
    scale = scale_from_pitch(grid(0.1, 0.1, 2.0, 45.0, 0.0, 1), 2.0, SIZE)
    assert scale.x == scale.y == pytest.approx(0.1, rel=1e-6)


@pytest.mark.parametrize(
    ("dots", "pitch", "words"),
    [
        ([[0, 0], [10, 0], [0, 10]], 2.0, "with --area instead"),
        *((grid(0.1, 0.1, 2.0, 0, 0, 1), pitch, "pitch: required > 0 mm") for pitch in (0.0, -1.0, np.nan)),
    ],
)
def test_too_few_dots_and_an_invalid_pitch_are_refused(dots: ArrayLike, pitch: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        scale_from_pitch(dots, pitch, SIZE)
