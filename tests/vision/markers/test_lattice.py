"""The lattice: what tells a grid, however bent, from marks at random."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.markers.lattice import Lattice, support
from tests.vision.dots import grid

FloatArray = NDArray[np.float64]
GRID = grid(10, 12, 30.0, corner=(0, 0), jitter=0.5)


def bent(kind: str) -> FloatArray:
    x, y = GRID.T
    if kind == "hexagonal":
        return np.column_stack([x + 15.0 * (np.rint(y / 30) % 2), 0.87 * y])
    if kind == "perspective":
        return GRID / (1 + y[:, None] / 300)
    if kind == "fisheye":
        away = (GRID - GRID.mean(axis=0)) / 220
        return np.asarray(220 * away / (1 + 0.4 * (away**2).sum(axis=1, keepdims=True)))
    if kind == "rings":
        return np.column_stack([(120 + y) * np.cos(x / 150), (120 + y) * np.sin(x / 150)])
    return GRID


@pytest.mark.parametrize("kind", ["square", "hexagonal", "perspective", "fisheye", "rings"])
def test_a_grid_closes_nearly_all_parallelograms_however_it_is_bent(kind: str) -> None:
    points = bent(kind)
    assert Lattice(points).closed_share > 0.85


def test_marks_at_random_close_few_even_if_they_keep_their_distance() -> None:
    rng, points = np.random.default_rng(6), np.zeros((0, 2))
    for point in rng.uniform(0, 400, (6000, 2)):
        if len(points) == 0 or np.hypot(*(points - point).T).min() > 22:
            points = np.vstack([points, point])
    assert len(points) > 180
    # Measured: 0.24 to 0.32, over seeds and distances.
    assert Lattice(points).closed_share < 0.35


def test_a_mark_beside_the_lattice_closes_nothing_and_hangs_together_with_nobody() -> None:
    points = np.vstack([GRID, [[165.0, 135.0]]])
    lattice = Lattice(points)
    assert lattice.own_shares[-1] == 0
    assert lattice.cluster_sizes[-1] == 1
    assert np.median(lattice.cluster_sizes[:-1]) == len(GRID)


def test_a_missing_mark_is_wanted_where_it_was() -> None:
    missing = 5 * 12 + 6
    points = np.delete(GRID, missing, axis=0)
    wanted = Lattice(points).corners
    assert support(np.array([GRID[missing], GRID[missing] + 15.0]), wanted).tolist() == [4, 0]


def test_the_next_row_towards_a_horizon_is_wanted_where_the_rows_draw_together() -> None:
    columns, rows = np.arange(0, 150, 30.0), np.array([0.0, 40, 70, 92, 108])
    points = np.array([(x, y) for y in rows[:4] for x in columns])
    next_row = np.array([(x, rows[4]) for x in columns])
    assert (support(next_row, Lattice(points).predicted) == 1).all()
    # Where rows are evenly spaced, both predictions of a line are one.
    even = np.array([(x, y) for y in np.arange(0, 120, 30.0) for x in columns])
    assert support(np.array([[60.0, 120.0]]), Lattice(even).predicted).tolist() == [1]


def test_a_step_over_a_missing_mark_does_not_make_the_next_one_longer() -> None:
    points = np.array([(x, y) for y in (0.0, 30.0, 60.0) for x in (0.0, 30.0, 60.0, 115.0)])
    wanted = Lattice(points).predicted
    assert support(np.array([[170.0, 30.0], [215.0, 30.0]]), wanted).tolist() == [1, 0]


def test_no_marks_and_one_mark_form_no_lattice() -> None:
    for count in (0, 1, 2):
        points = GRID[:count]
        assert Lattice(points).closed_share == 0
