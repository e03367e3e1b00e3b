"""What is said of a frame stays as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.sim import open_scene
from tactflow.tools.bench.lockstep import LockstepPipeline, TimedResult, on_recording

FRAMES = 20


def arrays(outcome: TimedResult) -> list[np.ndarray]:
    """All arrays that a frame's results hold."""
    found = [outcome.image, outcome.contact_mask]
    if outcome.markers is not None:
        markers = outcome.markers
        found += [markers.origin, markers.position, markers.status, markers.stderr]
    return found if outcome.contact is None else [*found, outcome.contact.hull]


@pytest.mark.parametrize(("pipeline", "scene"), [("default", "press"), ("markerless", "unmarked")])
def test_no_later_frame_changes_the_results_of_an_earlier_one(
    pipeline: str, scene: str, tmp_path: Path
) -> None:
    sensor, path = open_scene(f"{scene}?frames=300"), tmp_path / "frames.npy"
    # Untouched, and from the first touch on.
    order = [*range(5), *range(FRAMES, 2 * FRAMES)]
    np.save(path, np.stack([sensor.frame(index) for index in order]))
    run = LockstepPipeline(on_recording(load_pipeline(find_pipeline(pipeline)), path))
    outcomes, copies = [], []
    while outcome := run.block(1):
        outcomes += outcome
        copies.append([array.copy() for array in arrays(outcome[0])])
    assert len(outcomes) == len(order)
    assert any(outcome.contact is not None for outcome in outcomes)
    for outcome, kept in zip(outcomes, copies, strict=True):
        for array, copy in zip(arrays(outcome), kept, strict=True):
            np.testing.assert_array_equal(array, copy)
