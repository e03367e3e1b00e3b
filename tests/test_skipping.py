"""The law of skipping: an observer never changes values, and neither does leaving out work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import tactflow
from tactflow import Result
from tactflow.sim.export import write_frames

FRAMES = 60

MOST = {"markers": 0.06, "center": 1.0}
"""What a published number may differ by from a fresh one, px: some five times the deviation of two results of
noisy pictures."""


def run(pipeline: str, recording: Path, **settings: object) -> list[Result]:
    return list(tactflow.stream(pipeline, source=str(recording), settings=settings))


def published(result: Result) -> dict[str, np.ndarray]:
    """The numbers of a frame that are compared, px."""
    numbers = {}
    if result.markers is not None:
        numbers["markers"] = result.markers.position
    if result.contact is not None:
        numbers["center"] = np.array(result.contact.center)
    return numbers


# What is repeated at least, as a share of the frames: what is still in the scene, less the frames that learn
# the noise and those after a change.
@pytest.mark.parametrize(
    ("pipeline", "scene", "repeated"),
    [
        ("default", "press", 0.1),
        ("default", "tap", 0.2),
        ("default", "creep", 0.0),
        ("markerless", "unmarked", 0.1),
    ],
)
def test_what_is_repeated_differs_from_a_fresh_result_by_noise_alone(
    pipeline: str, scene: str, repeated: float, tmp_path: Path
) -> None:
    write_frames(tactflow.open_scene(f"{scene}?frames={FRAMES}"), tmp_path / "scene.npy")
    skipping, fresh = (run(pipeline, tmp_path / "scene.npy", skipping=on) for on in (True, False))
    assert [result.seq for result in skipping] == [result.seq for result in fresh] == list(range(FRAMES))
    assert sum("unchanged" in result.skipped.values() for result in skipping) >= repeated * FRAMES
    assert not any("unchanged" in result.skipped.values() for result in fresh)
    stale: set[str] = set()
    for one, other in zip(skipping, fresh, strict=True):
        numbers, expected = published(one), published(other)
        assert numbers.keys() == expected.keys(), f"frame {one.seq}"
        differ = {name for name, now in numbers.items() if np.abs(now - expected[name]).max() > MOST[name]}
        # A motion may begin too faintly to be seen in its first frame.
        assert not differ & stale, f"frame {one.seq}"
        stale = differ


def test_a_sink_that_looks_at_everything_changes_nothing(tmp_path: Path) -> None:
    recording = tmp_path / "scene.npy"
    write_frames(tactflow.open_scene(f"tap?frames={FRAMES}"), recording)
    video = {"sinks.video": {"path": str(tmp_path / "seen.avi")}}
    alone = run("default", recording)
    seen = list(tactflow.stream("default", source=str(recording), settings={"sinks": {}} | video, sinks=True))
    for one, other in zip(alone, seen, strict=True):
        assert published(one).keys() == published(other).keys()
        for name, values in published(one).items():
            np.testing.assert_array_equal(values, published(other)[name])
