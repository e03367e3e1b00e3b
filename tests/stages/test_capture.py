"""Capture: numbering, references, pace, stopping."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.engine.errors import SourceError
from tactflow.sources.base import FrameReader
from tactflow.sources.pace import MAX_GAP_S, Pace
from tactflow.stages.capture import Capture
from tests.clock import PATIENCE, ManualClock


@pytest.fixture
def recording(tmp_path: Path) -> str:
    """Six frames whose pixels tell their index."""
    path = tmp_path / "recording.npy"
    np.save(path, np.stack([np.full((4, 6, 3), index, np.uint8) for index in range(6)]))
    return str(path)


def capture(source: str, directory: Path | None = None, **params: Any) -> Capture:
    stage = Capture(Capture.Params(source=source, **params), sensor="thumb", directory=directory)
    stage.open()
    return stage


def test_frames_are_numbered_timed_and_read_only(recording: str) -> None:
    stage = capture(recording, fps=10.0)
    frames = list(stage.frames())
    stage.close()
    assert [frame.seq for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert [frame.t for frame in frames] == [index / 10.0 for index in range(6)]
    assert {frame.sensor for frame in frames} == {"thumb"}
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert not any(frame.image.flags.writeable for frame in frames)
    captured = [frame.captured for frame in frames]
    assert captured == sorted(captured)
    assert captured[-1] <= time.perf_counter()


@pytest.mark.parametrize("count", [1, 3, 6, 9])
def test_the_first_frames_are_the_reference(count: int, recording: str) -> None:
    frames = list(capture(recording, reference=count).frames())
    assert [frame.reference for frame in frames] == [index < count for index in range(6)]


def test_a_reference_image_comes_before_the_first_frame(recording: str, tmp_path: Path) -> None:
    gel = np.repeat(np.arange(90, 96, dtype=np.uint8)[None], 4, axis=0)
    cv2.imwrite(str(tmp_path / "gel.png"), gel)
    frames = list(capture(recording, directory=tmp_path, reference="gel.png").frames())
    assert [frame.seq for frame in frames] == [-1, 0, 1, 2, 3, 4, 5]
    assert [frame.reference for frame in frames] == [True] + [False] * 6
    np.testing.assert_array_equal(frames[0].image, np.dstack([gel] * 3))
    assert not frames[0].image.flags.writeable
    assert frames[0].t == frames[1].t


def test_a_reference_image_of_another_size_is_an_error_that_names_both(
    recording: str, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "gel.png"), np.repeat(np.arange(90, 96, dtype=np.uint8)[None], 5, axis=0))
    stage = capture(recording, reference=str(tmp_path / "gel.png"))
    with pytest.raises(SourceError, match=r"reference .* 6 x 5 pixels.*recording\.npy have 6 x 4"):
        next(stage.frames())


def test_a_missing_reference_image_is_a_source_error(recording: str) -> None:
    with pytest.raises(SourceError, match=r"^reference: missing\.png: no such file"):
        capture(recording, reference="missing.png")


@pytest.mark.parametrize("reference", [1, 2])
def test_retaking_the_reference_starts_a_new_epoch_with_as_many_frames(
    reference: int, recording: str
) -> None:
    stage = capture(recording, reference=reference)
    frames = []
    for frame in stage.frames():
        frames.append(frame)
        if frame.seq == 2:
            stage.retake()
    assert [frame.epoch for frame in frames] == [0, 0, 0, 1, 1, 1]
    assert [frame.reference for frame in frames[3:]] == [index < reference for index in range(3)]


def warming_up(path: Path, gains: list[float]) -> list[Any]:
    """Frames of a gel while the camera sets its exposure, as a recording at 10 frames per second."""
    gel = np.linspace(60, 120, 48 * 64 * 3).reshape(48, 64, 3)
    frames = [np.uint8(np.rint(gel * gain)) for gain in gains]
    np.save(path, np.stack(frames))
    return frames


@pytest.mark.parametrize("source", ["r.npy", "pictures"])
def test_a_recording_is_compared_with_the_first_frame_in_steady_light_and_keeps_all_frames(
    source: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = warming_up(tmp_path / "r.npy", [0.6, 0.7, 0.8, 0.9] + [1.0] * 16)
    (tmp_path / "pictures").mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "pictures" / f"{index}.png"), image)
    with caplog.at_level("INFO", "tactflow"):
        before, *frames = capture(source, tmp_path, fps=10.0).frames()
    assert (before.seq, before.reference, before.t) == (-1, True, 0.0)
    np.testing.assert_array_equal(before.image, images[4])
    assert [(frame.seq, frame.reference) for frame in frames] == [(i, False) for i in range(20)]
    assert all(np.array_equal(frame.image, image) for frame, image in zip(frames, images, strict=True))
    assert caplog.messages == [
        f"{source}: the reference is frame 4; the camera was setting exposure and white balance until then"
    ]


def test_a_gel_of_which_two_states_may_be_the_untouched_one_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = np.stack(warming_up(tmp_path / "r.npy", [1.0] * 30))
    images[:6, 16:32, 8:24] //= 2
    images[6:, 16:32, 40:56] //= 2
    np.save(tmp_path / "r.npy", images)
    with caplog.at_level("INFO", "tactflow"):
        frames = list(capture("r.npy", tmp_path).frames())
    assert [frame.seq for frame in frames if frame.reference] == [0]
    assert (
        "the reference is frame 0, although the gel came to rest in another state at frame 6" in caplog.text
    )


def test_the_reference_of_a_folder_of_separate_pictures_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = warming_up(tmp_path / "r.npy", [1.0] * 12)
    (tmp_path / "alike").mkdir()
    (tmp_path / "separate").mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "alike" / f"{index}.png"), image)
        touched = image.copy()
        touched[16:32, 4 * index : 4 * index + 16] //= 2
        name = f"press-{index}.png" if index < 11 else "untouched.png"
        cv2.imwrite(str(tmp_path / "separate" / name), touched if index < 11 else image)
    with caplog.at_level("INFO", "tactflow"):
        list(capture("alike", tmp_path).frames())
        assert caplog.messages == ["alike: all 12 pictures are the same: a camera that stood still?"]
        caplog.clear()
        frames = list(capture("separate", tmp_path).frames())
        assert [frame.seq for frame in frames if frame.reference] == [0]
        assert "separate pictures; press-0.png, the first by name, is taken" in caplog.messages[0]
        caplog.clear()
        frames = list(capture("separate", tmp_path, reference="separate/untouched.png").frames())
        assert np.array_equal(frames[0].image, images[0])
        assert not caplog.messages


@pytest.mark.parametrize(("settle", "reference"), [(0, 0), (3, -1)])
def test_settling_can_be_switched_off(tmp_path: Path, settle: float, reference: int) -> None:
    warming_up(tmp_path / "r.npy", [0.6, 0.8] + [1.0] * 18)
    first = next(capture("r.npy", tmp_path, settle=settle).frames())
    assert (first.seq, first.reference) == (reference, True)


def test_light_that_never_becomes_steady_is_a_warning_after_the_time_stated(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    warming_up(tmp_path / "r.npy", [1.02**i for i in range(40)])
    frames = list(capture("r.npy", tmp_path, fps=10.0, settle=2.0).frames())
    assert [frame.seq for frame in frames] == list(range(-1, 40))
    assert "the light is not steady" in caplog.messages[0]


def test_of_several_references_none_shows_an_early_contact(tmp_path: Path) -> None:
    images = warming_up(tmp_path / "r.npy", [1.0] * 30)
    for image in images[6:]:
        image[16:32, 16:40] //= 2
    np.save(tmp_path / "r.npy", np.stack(images))
    frames = list(capture("r.npy", tmp_path, reference=12).frames())
    assert [frame.seq for frame in frames if frame.reference] == list(range(6))


def test_skipped_frames_leave_their_numbers_unused(recording: str) -> None:
    stage = capture(recording, skip=4)
    assert stage.total == 2
    frames = list(stage.frames())
    assert [(frame.seq, frame.reference) for frame in frames] == [(4, True), (5, False)]


def test_a_recording_is_live_only_when_played_at_its_own_pace(recording: str) -> None:
    assert not capture(recording).live
    assert capture(recording, realtime=True).live


def test_after_a_long_interruption_the_recording_continues_instead_of_rushing() -> None:
    clock = ManualClock()
    pace = Pace(threading.Event(), clock)
    pace.wait_for(0.0)
    clock.advance(3600.0)
    pace.wait_for(0.1)
    resumed = clock.now()
    pace.wait_for(0.2)
    # 1e-9 s: rounding.
    assert clock.now() - resumed == pytest.approx(0.1, abs=1e-9)


def test_a_gap_of_more_than_a_minute_is_skipped_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    clock = ManualClock()
    pace = Pace(threading.Event(), clock)
    shown = []
    for t in (0.0, 0.1, 0.1 + MAX_GAP_S, 1e9, 1e9 + 0.1):
        assert pace.wait_for(t)
        shown.append(clock.now() - shown[0] if shown else clock.now())
    # 1e-6 s: rounding at 1e9 s.
    np.testing.assert_allclose(np.diff(shown)[1:], [MAX_GAP_S, 0.0, 0.1], atol=1e-6)
    assert [record.getMessage() for record in caplog.records] == [
        "the recording pauses for 1e+09 s, which is skipped"
    ]


class _Stamped(FrameReader):
    """Frames at given times."""

    def __init__(self, times: list[float]) -> None:
        super().__init__("stamped")
        self.times = times

    def _frames(self) -> Iterator[tuple[Any, ...]]:
        for t in self.times:
            yield np.zeros((8, 8, 3), np.uint8), t


def test_times_that_run_back_are_counted_on_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    times = [0.0, 0.1, 0.05, 0.15, 9e8, 0.2, 0.3]
    stage = Capture(Capture.Params(source="stamped"), opener=lambda *_args, **_words: _Stamped(times))
    stage.open()
    counted = [frame.t for frame in stage.frames()]
    # 1e-6 s: rounding at 9e8 s.
    np.testing.assert_allclose(counted, [0.0, 0.1, 0.1, 0.2, 9e8 + 0.05, 9e8 + 0.05, 9e8 + 0.15], atol=1e-6)
    assert [message for message in caplog.messages if "times" in message] == [
        "stamped: its times run back by 0.05 s; they are counted on from there",
    ]


def test_stopping_wakes_a_capture_that_waits_for_its_next_frame(
    recording: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactflow.sources.pace.MAX_GAP_S", np.inf)
    # At this rate the second frame is due after 1000 s; the test's own time limit is far shorter.
    stage = capture(recording, realtime=True, fps=0.001)
    frames = []
    first = threading.Event()

    def run() -> None:
        for frame in stage.frames():
            frames.append(frame)
            first.set()

    thread = threading.Thread(target=run)
    thread.start()
    assert first.wait(PATIENCE)
    stage.stop()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    assert len(frames) == 1


def test_a_camera_index_may_be_a_number() -> None:
    assert Capture.Params.model_validate({"source": 0}).source == "0"
