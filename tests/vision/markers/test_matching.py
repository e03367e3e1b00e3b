"""Spots are chosen by the kernels as by plain numpy; marks that are not there are refused."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.markers.matching import choose_spots
from tests.oracles import matching
from tests.oracles.plain import plain
from tests.vision.dots import grid


def test_spots_are_chosen_alike() -> None:
    rng = np.random.default_rng(0)
    jointly = 0
    for _ in range(800):
        columns, rows = rng.integers(1, 9, 2)
        origin = grid(int(rows), int(columns), 20.0, corner=(0.0, 0.0)) + rng.normal(
            0, 0.4, (rows * columns, 2)
        )
        edges = neighbour_graph(origin, 52.0)
        moved = rng.normal(0, rng.choice([0.1, 3.0, 8.0]), (1, 2))
        moved = moved + rng.normal(0, rng.choice([0.1, 1.0, 5.0, 14.0]), origin.shape)
        inliers = rng.random(len(origin)) < rng.choice([0.0, 0.3, 0.7])
        free = np.flatnonzero(~inliers & (rng.random(len(origin)) < rng.choice([0.9, 1.0])))
        spots = (origin + moved)[free][rng.random(len(free)) < rng.choice([0.4, 0.8, 1.0])]
        spots = np.concatenate([spots, rng.uniform(-20, 200, (rng.integers(0, 6), 2))])
        strength = rng.uniform(0.3, 1.3, len(spots))
        expected = np.stack([origin[free], origin[free] + moved.mean(axis=0)])
        given = (origin, edges, free, inliers, moved, expected, spots, strength)
        chosen = choose_spots(*given, pitch=20.0, farthest=26.0)
        with plain(matching):
            plainly = choose_spots(*given, pitch=20.0, farthest=26.0)
        # Costs differ in their last digits, so only an exact draw between two choices could fall otherwise.
        np.testing.assert_array_equal(chosen, plainly)
        jointly += int((chosen >= 0).sum() > 3)
    assert jointly > 400


@pytest.mark.parametrize(
    ("edges", "free"), [([[0, 2]], [0]), ([[-1, 0]], [0]), ([[0, 1]], [2]), ([[0, 1]], [-1])]
)
def test_marks_that_are_not_there_are_refused(edges: list[list[int]], free: list[int]) -> None:
    origin = np.array([[0.0, 0.0], [10.0, 0.0]])
    with pytest.raises(IndexError, match="required marks 0 to 1 in edges and free"):
        choose_spots(
            origin, np.array(edges), np.array(free), np.zeros(2, bool), np.zeros((2, 2)), origin[None, :1],
            origin, np.ones(2), pitch=10.0, farthest=13.0,
        )  # fmt: skip
