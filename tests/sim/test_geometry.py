"""A marker has its centre where the truth says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene


def centroid(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """(x, y), px."""
    rows, columns = np.indices(weight.shape)
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("kind", ["shape=round", "shape=square", "shape=doubled", "polarity=bright"])
def test_a_marker_of_any_kind_has_its_centre_at_its_position(kind: str) -> None:
    # A single marker, thrown by up to 0.45 x 400 px off the centre: another sub-pixel place for each seed.
    for seed in (3, 4):
        scene = open_scene(
            f"idle?markers=1x1&noise=0&texture=0&jitter=0.3&pitch=400&dot=10&frames=1&seed={seed}&{kind}"
        )
        image, clean = scene.frame(0).astype(np.float64), scene.clean(0).astype(np.float64)
        # Opacity: dark markers scale the light, bright ones mix it with level 225.
        opaque = (image - clean) / (225.0 - clean) if "bright" in kind else 1 - image / clean
        # Derived: two pictures rounded to whole levels of 130 (0.29 each), seen as a dot of 10 px radius,
        # leave about 0.002 px in its centre of gravity.
        np.testing.assert_allclose(centroid(opaque.mean(axis=-1)), scene.truth(0).position[0], atol=0.01)


@pytest.mark.parametrize("query", ["perspective=0.3", "distortion=0.25"])
def test_markers_seen_by_a_tilted_or_wide_camera_are_where_the_truth_says(query: str) -> None:
    settings = "noise=0&texture=0&frames=1&markers=6x5&vignette=0"
    scene = open_scene(f"idle?{settings}&{query}")
    image, clean = scene.frame(0).astype(np.float64), scene.clean(0).astype(np.float64)
    dark = (1 - image / np.maximum(clean, 1)).mean(axis=-1)
    dark = np.where(clean.min(axis=-1) > 30, dark, 0.0)
    checked = 0
    for x, y in scene.truth(0).position:
        if not (40 < x < 760 and 40 < y < 560):
            continue
        left, top = round(x) - 24, round(y) - 24
        center = centroid(dark[top : top + 49, left : left + 49]) + np.array([left, top])
        # Derived: rounding, 0.002 px; the shading of the unmarked picture is divided out.
        np.testing.assert_allclose(center, (x, y), atol=0.01)
        checked += 1
    assert checked >= 20
