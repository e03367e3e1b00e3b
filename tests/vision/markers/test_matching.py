"""The graph of neighbours: links of little strain, and the largest component that moves together."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.markers.lattice import neighbour_graph
from tactflow.vision.markers.matching import MarkerGraph
from tests.vision.dots import grid


def test_of_several_grids_each_has_its_largest_component() -> None:
    first, second = grid(4, 4, 12.0, corner=(10.0, 10.0)), grid(5, 4, 12.0, corner=(90.0, 70.0))
    edges = np.concatenate([neighbour_graph(first, 30.0), neighbour_graph(second, 30.0) + 16])
    under_test = MarkerGraph(np.concatenate([first, second]), edges)
    origin = np.concatenate([first, second])
    seen, moved = np.ones(36, bool), origin.copy()
    moved[[0, 5]] += 100.0
    expected = ~np.isin(np.arange(36), [0, 5])
    smooth, torn = under_test.check(moved, seen)
    assert torn
    np.testing.assert_array_equal(under_test.largest_component(seen, smooth), expected)
    seen[[0, 5, 20]] = expected[20] = False
    smooth, torn = under_test.check(moved, seen)
    assert not torn
    np.testing.assert_array_equal(under_test.largest_component(seen, smooth), expected)


def test_edges_to_marks_that_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match="required edges between marks 0 to 1"):
        MarkerGraph(np.zeros((2, 2)), np.array([[0, 2]]))
