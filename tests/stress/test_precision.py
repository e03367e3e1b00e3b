"""Coordinates that are far from zero."""

from __future__ import annotations

import numpy as np

from tactflow.vision.geometry import Preprocessor
from tactflow.vision.markers.lattice import neighbour_graph
from tests.stress.builders import gel

FAR = 1e6
"""Offset of coordinates, px."""
ULP = float(np.spacing(FAR))
"""Distance of neighbouring float64 numbers at `FAR`: 1.2e-10 px."""


def test_neighbours_a_million_pixels_away_are_the_same_neighbours() -> None:
    origin = gel().origin
    expected = neighbour_graph(origin, 70)
    assert len(expected) == 38
    for offset in ((FAR, 0), (-FAR, FAR)):
        np.testing.assert_array_equal(neighbour_graph(origin + offset, 70), expected)


def test_a_mapping_and_its_inverse_a_million_pixels_away() -> None:
    mapping = Preprocessor((800, 600), rotate=90, downsample=4, crop=(7, 5, 700, 500)).mapping
    points = np.random.default_rng(0).uniform(-FAR, FAR, (100, 2))
    # Affine: some ten operations, each of half an ulp.
    assert np.abs(mapping.to_raw(mapping.to_processed(points)) - points).max() <= 10 * ULP
