"""The tracker stage: references, reset, parameters."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.frame import Frame
from tactflow.stages.tracker import Tracker
from tactflow.vision.markers.detection import NoMarkersError
from tactflow.vision.types import Markers, MarkerStatus
from tests.vision.dots import grid, render

TRUTH = grid(6, 6, 30.0, corner=(25.0, 28.0), jitter=0.4)


def picture(shift: tuple[float, float], *, seed: int = 0, noise: float = 1.0) -> NDArray[np.uint8]:
    return render((205, 210), TRUTH + np.array(shift), 4.2, noise=noise, seed=seed)


def feed(stage: Tracker, image: NDArray[np.uint8], seq: int, *, reference: bool = False) -> Markers:
    return stage.process(image, Frame("test", seq, seq / 60, image, reference=reference))


def test_without_a_reference_the_first_frame_is_one() -> None:
    stage = Tracker(Tracker.Params())
    feed(stage, picture((0, 0)), 0)
    markers = feed(stage, picture((2.5, -1.5), seed=1), 1)
    np.testing.assert_allclose(markers.displacement, np.tile([2.5, -1.5], (36, 1)), atol=0.08)
    assert (markers.status == MarkerStatus.TRACKED).all()


def test_displacements_count_from_the_reference_not_from_the_frame_before() -> None:
    stage = Tracker(Tracker.Params())
    feed(stage, picture((0, 0)), -1, reference=True)
    for seq in range(5):
        markers = feed(stage, picture((seq, 0.5 * seq), seed=seq + 1), seq)
    np.testing.assert_allclose(markers.displacement, np.tile([4.0, 2.0], (36, 1)), atol=0.08)


def test_several_reference_frames_are_averaged_and_keep_the_index_of_every_marker() -> None:
    size = {}
    for count in (1, 8):
        stage = Tracker(Tracker.Params())
        for seq in range(count):
            first = feed(stage, picture((0, 0), seed=seq, noise=4.0), seq, reference=True)
        found = [feed(stage, picture((3, 1), seed=50 + seq, noise=4.0), count + seq) for seq in range(6)]
        np.testing.assert_allclose(found[0].origin, first.origin, atol=0.3)
        mean = np.mean([markers.displacement for markers in found], axis=0)
        size[count] = np.sqrt(np.mean((mean - [3, 1]) ** 2))
    # Without noise in the frames the ratio would be 1 / sqrt(8).
    assert size[8] < 0.8 * size[1]


def test_a_later_reference_without_dots_leaves_the_earlier_ones(caplog: pytest.LogCaptureFixture) -> None:
    stage, covered = Tracker(Tracker.Params()), np.full_like(picture((0, 0)), 120)
    feed(stage, picture((0, 0)), 0)
    stage.reset()
    lost = stage.process(covered, Frame("test", 1, 1 / 60, covered, reference=True, epoch=1))
    assert (lost.status != MarkerStatus.TRACKED).all()
    assert "frame 1: the new reference shows no dots" in caplog.text
    markers = feed(stage, picture((2, 1), seed=2), 2)
    np.testing.assert_allclose(markers.displacement, np.tile([2.0, 1.0], (36, 1)), atol=0.08)


def test_a_first_reference_without_dots_is_refused() -> None:
    stage, covered = Tracker(Tracker.Params()), np.full_like(picture((0, 0)), 120)
    feed(stage, picture((0, 0)), 0)
    stage.reset()
    with pytest.raises(NoMarkersError):
        feed(stage, covered, 0, reference=True)


def test_reset_takes_a_new_reference() -> None:
    stage = Tracker(Tracker.Params())
    feed(stage, picture((0, 0)), 0)
    stage.reset()
    feed(stage, picture((5, 5), seed=1), 1)
    markers = feed(stage, picture((5, 5), seed=2), 2)
    assert np.abs(markers.displacement).max() < 0.08


def test_no_markers_is_an_error_that_names_the_markerless_pipeline() -> None:
    with pytest.raises(ValueError, match=r"0 markers found: .* use the pipeline markerless"):
        feed(Tracker(Tracker.Params()), np.full((200, 200, 3), 90, np.uint8), 0)
