"""The tracker with its kernels against the tracker in plain numpy and OpenCV."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.stages.tracker import Tracker
from tactflow.vision import compiled
from tactflow.vision.markers import graph, matching, template, tracking
from tactflow.vision.markers.detection import Detection, detect_markers
from tactflow.vision.markers.template import Alignment
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers
from tests.oracles import graph as plain_graph
from tests.oracles import matching as plain_matching
from tests.oracles import template as plain_template
from tests.oracles import tracking as plain_tracking
from tests.oracles.plain import plain
from tests.vision.dots import FloatArray, grid, render

ORACLES = (plain_graph, plain_matching, plain_template, plain_tracking)
SIZE = (150, 170)
PITCH = 24.0
TRUTH = grid(7, 6, PITCH, corner=(14.3, 13.8), jitter=0.4)


def picture(centers: FloatArray, seed: int = 0) -> NDArray[np.uint8]:
    return render(SIZE, centers, 3.4, noise=1.0, seed=seed)


@cache
def reference() -> tuple[NDArray[np.uint8], Detection]:
    frame = picture(TRUTH, seed=99)
    return frame, detect_markers(frame)


@pytest.mark.parametrize("seed", range(6))
def test_marks_are_judged_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    under_test = MarkerTracker(*reference())
    doubts = set()
    for trial in range(60):
        size = rng.choice([0.05, 0.5, 4.0])
        r_squared = np.where(rng.random(42) < rng.choice([0.0, 0.1]), 0.4, 0.9).astype(np.float32)
        gain = np.where(rng.random(42) < rng.choice([0.0, 0.02]), 3.5, 1.0).astype(np.float32)
        under_test._position = under_test._origin + rng.normal(0, 0.3, (42, 2))
        under_test._seen = rng.random(42) < rng.choice([0.0, 0.9, 1.0])
        position = under_test._position + rng.normal(0, size, (42, 2))
        if trial % 4 == 0:
            position += np.array([2.0, -1.0])
        measured = Alignment(position, gain, r_squared, np.zeros_like(gain))
        seen, strain, doubt = under_test._check(measured)
        with plain(*ORACLES):
            expected = under_test._check(measured)
        np.testing.assert_array_equal(seen, expected[0])
        assert doubt == expected[2]
        doubts.add(doubt)
        inliers = under_test._graph.largest_component(seen, strain)
        with plain(*ORACLES):
            np.testing.assert_array_equal(inliers, under_test._graph.largest_component(seen, strain))
    assert doubts == {0, 1, 2}


def test_the_stage_has_its_loops_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    loops = [
        loop
        for module in (graph, matching, template, tracking)
        for loop in vars(module).values()
        if isinstance(loop, compiled.Kernel)
    ]
    assert len(loops) == 5
    for loop in loops:
        monkeypatch.setattr(loop, "_compiled", None)
    Tracker(Tracker.Params())
    assert all(loop._compiled is not None for loop in loops)


def _sequence(jumpy: bool) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(21)
    frames = []
    for step in range(40):
        bend = np.exp(-((TRUTH - SIZE[0] / 2) ** 2).sum(axis=1) / (2 * 50.0**2))
        shift = np.array([0.4 * step, 6.0 * np.sin(step / 5)])
        if jumpy:
            angle = rng.uniform(0, 2 * np.pi)
            shift = rng.uniform(0, 0.9) * PITCH * np.array([np.cos(angle), np.sin(angle)])
            bend = bend if step % 3 else np.ones_like(bend)
        now = TRUTH + bend[:, None] * shift
        if step % 2:
            now = now[rng.random(len(now)) > 0.08]
        if step % 5 == 0:
            now = np.concatenate([now, rng.uniform(10, 140, (4, 2))])
        frames.append(picture(now, seed=step))
    return frames


@pytest.mark.parametrize("jumpy", [False, True])
def test_a_recording_is_tracked_alike(jumpy: bool) -> None:
    frames = _sequence(jumpy)
    runs: list[list[Markers]] = []
    for oracles in ((), ORACLES):
        with plain(*oracles):
            under_test = MarkerTracker(*reference())
            runs.append([under_test.track(frame) for frame in frames])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.status, other.status)
        # Differences do not add up, as every position is measured against the reference: measured 4e-7 px and
        # 2e-6 px.
        np.testing.assert_allclose(one.position, other.position, atol=1e-5)
        np.testing.assert_allclose(one.stderr, other.stderr, atol=2e-5)
    assert any((markers.status != 0).any() for markers in runs[0])
