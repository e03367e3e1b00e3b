"""A dot at a known place is found there, whatever the preprocessing."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import Scene, open_scene
from tactflow.sim.markers import coverage
from tactflow.vision.geometry import Preprocessor

# The dot grows with the sampling step, and is blurred by twice the step: at the frequency that a step of n px
# folds back, exp(-(2 pi 2)^2 / 2) = 5e-35 of its contrast is left: the mapping is tested, not the filter.
RADIUS = {1: 14.0, 2: 26.0, 4: 52.0}
BLUR = {1: 2.0, 2: 4.0, 4: 8.0}
HOMOGRAPHIES: dict[str, Any] = {
    "none": None,
    "shrinks": (
        [(40, 30), (770, 20), (90, 580), (720, 560)], [(0, 0), (639, 0), (0, 479), (639, 479)], (640, 480),
    ),
    "grows": (
        [(150, 60), (640, 60), (60, 560), (760, 560)], [(0, 0), (799, 0), (0, 599), (799, 599)], (800, 600),
    ),
}  # fmt: skip


@lru_cache(maxsize=len(RADIUS) * 3)
def one_dot(seed: int, downsample: int) -> tuple[Scene, NDArray[np.uint8], NDArray[np.uint8]]:
    # A single marker, thrown by up to 0.45 x 400 px off the centre: another sub-pixel place for each seed.
    scene = open_scene(
        f"idle?markers=1x1&noise=0&texture=0&jitter=0.3&pitch=400&dot={RADIUS[downsample]}&frames=1&seed={seed}&blur={BLUR[downsample]}"
    )
    return scene, scene.frame(0), scene.clean(0)


def found(image: NDArray[np.uint8], unmarked: NDArray[np.uint8], half: int) -> NDArray[np.float64]:
    """Centre of gravity of the darkness relative to the picture without markers, (x, y) px."""
    lit = unmarked.min(axis=-1) > 20
    dark = 1.0 - image / np.maximum(unmarked, 1.0)
    dark = np.where(lit, dark.mean(axis=-1), 0.0)
    row, column = np.unravel_index(int(np.argmax(cv2.GaussianBlur(dark, (0, 0), half / 3))), dark.shape)
    top, left = max(int(row) - half, 0), max(int(column) - half, 0)
    window = dark[top : top + 2 * half + 1, left : left + 2 * half + 1]
    # No threshold is needed: without noise both pictures are equal to the bit where the dot is not.
    rows, columns = np.indices(window.shape)
    total = window.sum()
    return np.array([(columns * window).sum() / total + left, (rows * window).sum() / total + top])


def expected(mapping: Any, center: NDArray[np.float64], radius: float, blur: float) -> NDArray[np.float64]:
    """Centre of gravity of the dot's picture.

    A homography maps the dot's centre c to f(c), but the dot's picture has its centre of gravity at
    integral of f(p) a(p) |df/dp| dp over integral of a(p) |df/dp| dp, a being the dot's coverage: it lies off
    f(c) by second-order terms (up to 0.2 px here). Without a homography f is affine and both are the same.
    """
    # As many samples for a large dot as for a small one.
    line = np.linspace(-radius - 4 * blur, radius + 4 * blur, 89)
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    sharp = coverage(*offsets.T.astype(np.float32), radius, "round").reshape(len(line), -1)
    weight = cv2.GaussianBlur(sharp, (0, 0), blur / (line[1] - line[0])).ravel().astype(np.float64)
    right, down = np.diag([0.05, 0.05])
    places = center + offsets
    d_right = mapping.to_processed(places + right) - mapping.to_processed(places - right)
    d_down = mapping.to_processed(places + down) - mapping.to_processed(places - down)
    weight *= np.abs(d_right[:, 0] * d_down[:, 1] - d_right[:, 1] * d_down[:, 0])
    return np.asarray(weight @ mapping.to_processed(places) / weight.sum(), dtype=np.float64)


@pytest.mark.parametrize(
    ("homography", "downsample", "method", "cropped"),
    [
        # Each homography and each way to downsample with and without a crop.
        (homography, downsample, method, (i + j) % 2 > 0)
        for i, homography in enumerate(HOMOGRAPHIES)
        for j, (downsample, method) in enumerate(
            [(1, "area"), (2, "area"), (2, "pyramid"), (4, "area"), (4, "pyramid")]
        )
    ],
)
def test_a_dot_is_found_where_the_truth_says(
    homography: str, downsample: int, method: Any, cropped: bool
) -> None:
    errors = []
    radius, blur = RADIUS[downsample], BLUR[downsample]
    for rotate, seed in ((0, 1), (90, 2), (180, 3), (270, 1)):
        scene, image, clean = one_dot(seed, downsample)
        width, height = (800, 600) if homography == "none" else HOMOGRAPHIES[homography][2]
        preprocess = Preprocessor(
            (800, 600),
            rotate=rotate,
            downsample=downsample,
            method=method,
            crop=(33, 21, width - 70, height - 51) if cropped else None,
            homography=HOMOGRAPHIES[homography],
        )
        truth = scene.truth(0, preprocess)
        assert len(truth.position) == 1
        raw = scene.truth(0).position[0]
        np.testing.assert_allclose(truth.position[0], preprocess.mapping.to_processed(raw))
        half = round((radius + 4 * blur) / downsample * (1.7 if homography == "grows" else 1.0))
        errors.append(
            found(preprocess(image), preprocess(clean), half)
            - expected(preprocess.mapping, raw, radius, blur)
        )
    # Derived: two pictures rounded to whole levels of 130 (0.29 each), seen as a dot of 13 px radius, leave
    # about 0.002 px in its centre of gravity; the 1/32 px steps of a remap (0.009 each, alike along a row, so
    # over some ten rows of the rim) leave 0.003. The largest of eight errors is about three times that.
    assert np.abs(errors).max() < 0.01


@pytest.mark.parametrize("kind", ["shape=round", "shape=square", "shape=doubled", "polarity=bright"])
def test_a_marker_of_any_kind_has_its_centre_at_its_position(kind: str) -> None:
    for seed in (3, 4):
        scene = open_scene(
            f"idle?markers=1x1&noise=0&texture=0&jitter=0.3&pitch=400&dot=10&frames=1&seed={seed}&{kind}"
        )
        image, clean = scene.frame(0).astype(np.float64), scene.clean(0).astype(np.float64)
        # Opacity: dark markers scale the light, bright ones mix it with level 225.
        opaque = (image - clean) / (225.0 - clean) if "bright" in kind else 1 - image / clean
        opaque = opaque.mean(axis=-1)
        rows, columns = np.indices(opaque.shape)
        center = np.array([(columns * opaque).sum(), (rows * opaque).sum()]) / opaque.sum()
        # Derived as above: rounding leaves 0.002 px for a dot of 10 px.
        np.testing.assert_allclose(center, scene.truth(0).position[0], atol=0.01)


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
        window = dark[top : top + 49, left : left + 49]
        rows, columns = np.indices(window.shape)
        center = (columns * window).sum() / window.sum() + left, (rows * window).sum() / window.sum() + top
        # Derived: rounding, 0.002 px; the shading of the unmarked picture is divided out.
        np.testing.assert_allclose(center, (x, y), atol=0.01)
        checked += 1
    assert checked >= 20
