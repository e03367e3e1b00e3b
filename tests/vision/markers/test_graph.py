"""The graph of neighbours: strain of the links, and the largest component that moves together."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.vision.markers.graph import MarkerGraph
from tactflow.vision.markers.lattice import neighbour_graph
from tests.oracles import graph
from tests.oracles.plain import plain
from tests.vision.dots import grid


def test_components_of_several_grids_are_found_alike() -> None:
    rng = np.random.default_rng(4)
    first, second = grid(4, 4, 12.0, corner=(10.0, 10.0)), grid(5, 4, 12.0, corner=(90.0, 70.0))
    centers = np.concatenate([first, second])
    edges = np.concatenate([neighbour_graph(first, 30.0), neighbour_graph(second, 30.0) + 16])
    under_test = MarkerGraph(centers, edges)
    sizes = set()
    for _ in range(200):
        seen, strain = rng.random(36) < 0.8, rng.uniform(0, rng.choice([0.4, 0.8]), len(edges))
        component = under_test.largest_component(seen, strain)
        with plain(graph):
            np.testing.assert_array_equal(component, under_test.largest_component(seen, strain))
        assert component[:16].any()
        assert component[16:].any()
        sizes.add(int(component.sum()))
    assert len(sizes) > 5


def test_strain_is_the_difference_of_displacements_over_the_distance() -> None:
    rng = np.random.default_rng(3)
    origin = grid(4, 5, 12.0, corner=(10.0, 10.0))
    under_test = MarkerGraph(origin, neighbour_graph(origin, 30.0))
    position = origin + rng.normal(0, 2, origin.shape)
    strain = under_test.strain(position)
    with plain(graph):
        # The same operations; numpy may fuse a product and a sum, which spares one rounding.
        np.testing.assert_allclose(strain, under_test.strain(position), rtol=1e-14)


def test_edges_to_marks_that_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match="required edges between marks 0 to 1"):
        MarkerGraph(np.zeros((2, 2)), np.array([[0, 2]]))
