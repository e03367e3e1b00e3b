"""Plain versions of the kernels of the graph of neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.graph import LINKED_STRAIN, largest_components, link_strains
from tests.oracles.gains import Gain

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def plain_link_strains(
    position: FloatArray, origin: FloatArray, edges: IntArray, length: FloatArray, strain: FloatArray
) -> None:
    """Lengths of differences of displacements over those of the links."""
    moved = position - origin
    strain[:] = np.linalg.norm(moved[edges[:, 0]] - moved[edges[:, 1]], axis=1) / length


def plain_largest_components(
    seen: BoolArray,
    strain: FloatArray,
    first: IntArray,
    links: IntArray,
    votes: IntArray,
    grid: IntArray,
    inliers: BoolArray,
) -> None:
    """A search through the graph, by lists."""
    linked = (strain < LINKED_STRAIN).tolist()
    waiting = seen.tolist()
    best: dict[int, tuple[int, list[int]]] = {}
    for seed in range(len(seen)):
        if not waiting[seed]:
            continue
        waiting[seed] = False
        component = [seed]
        for mark in component:
            for other, edge in links[first[mark] : first[mark + 1]].tolist():
                if waiting[other] and linked[edge]:
                    waiting[other] = False
                    component.append(other)
        weight = int(votes[component].sum())
        home = int(grid[seed])
        if weight > best.get(home, (0, []))[0]:
            best[home] = (weight, component)
    inliers[:] = False
    for _, component in best.values():
        inliers[component] = True


GAINS = [
    # numpy may fuse a product and a sum, which spares one rounding.
    Gain(link_strains, plain_link_strains, tolerance=1e-13),
    Gain(largest_components, plain_largest_components),
]
