"""The record sink: nothing lost, nothing replaced, and the right moments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from pydantic import ValidationError

from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Pipeline
from tactflow.message.result import Result
from tactflow.recording.frames import parse_frame
from tactflow.sinks.record import Record
from tactflow.sources import Arrival, open_source
from tactflow.vision.types import Contact

FPS = 10.0
TOUCH = Contact(4.0, (1.0, 1.0), None, None, np.array([[0.0, 0], [2, 0], [2, 2]]), None)


def image(seq: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seq + 1000).integers(0, 256, (12, 17, 3), np.uint8)


def frame_of(seq: int) -> Frame:
    return Frame("main", seq, seq / FPS, image(seq), reference=seq == 0)


def opened(path: Path, **params: Any) -> Record:
    sink = Record(Record.Params(path=str(path), **params))
    sink.open()
    return sink


def write(sink: Record, seqs: range, contact: Contact | None = None) -> None:
    for seq in seqs:
        if sink.wants() or seq == 0:
            sink.write(Result(frame_of(seq), {"contact": contact}))


def stored(path: Path) -> list[Arrival]:
    """The frames of a recording."""
    source = open_source(str(path))
    found = list(iter(source.read_arrival, None))
    source.close()
    return found


def seqs_in(path: Path) -> list[int]:
    """The frames of a recording, after comparing their pixels with what was written."""
    for frame in (found := stored(path)):
        np.testing.assert_array_equal(frame.image, image(frame.seq))
        assert frame.t == frame.seq / FPS
        assert frame.reference == (frame.seq == 0)
    return [frame.seq for frame in found]


def test_the_button_makes_numbered_files_each_with_the_references(tmp_path: Path) -> None:
    (tmp_path / "press-007.mcap").write_bytes(b"older")
    sink = opened(tmp_path / "press.mcap", trigger="button")
    assert not sink.recording
    assert not sink.wants()
    write(sink, range(5))
    for first in (5, 20):
        sink.start_recording()
        assert sink.recording
        sink.start_recording()
        write(sink, range(first, first + 4))
        sink.stop_recording()
        assert not sink.recording
        write(sink, range(first + 4, first + 6))
    sink.stop_recording()
    sink.close()
    assert [path.name for path in sorted(tmp_path.iterdir())] == [f"press-00{i}.mcap" for i in (7, 8, 9)]
    assert seqs_in(tmp_path / "press-008.mcap") == [0, 5, 6, 7, 8]
    assert seqs_in(tmp_path / "press-009.mcap") == [0, 20, 21, 22, 23]


def test_the_ring_saves_its_last_seconds_while_frames_go_on(tmp_path: Path) -> None:
    sink = opened(tmp_path / "ring.mcap", ring=2.0)
    write(sink, range(100))
    assert not list(tmp_path.iterdir())
    assert sink.counters()["ring_frames"] == 21
    sink.start_recording()
    assert sink.recording
    write(sink, range(100, 110))
    assert not sink.recording
    sink.close()
    assert seqs_in(tmp_path / "ring-001.mcap") == [0, *range(79, 100)]


def test_the_ring_is_saved_at_once_while_the_run_is_paused(tmp_path: Path) -> None:
    class Paused:
        paused = True
        source = None
        pipeline = Pipeline("nowhere.yaml", tmp_path, "main", {})

    sink = Record(Record.Params(path=str(tmp_path / "ring.mcap"), ring=2.0), control=Paused())  # type: ignore[arg-type]
    sink.open()
    write(sink, range(50))
    sink.start_recording()
    assert not sink.recording
    assert seqs_in(tmp_path / "ring-001.mcap") == [0, *range(29, 50)]
    sink.close()


def test_the_ring_never_takes_more_memory_than_allowed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (500, 700, 3), np.uint8)
    sink = opened(tmp_path / "ring.mcap", ring=1000.0, memory=16, preview=0)
    for seq in range(30):
        sink.write(Result(Frame("main", seq, seq / FPS, noise)))
        assert sink.counters()["ring_bytes"] <= 16_000_000
    assert 10 <= sink.counters()["ring_frames"] < 30
    assert caplog.text.count("as memory is limited to 16 MB") == 1
    sink.close()


def test_each_contact_gets_a_file_with_what_came_before_and_after(tmp_path: Path) -> None:
    sink = opened(tmp_path / "touch.mcap", ring=1.0, trigger="contact", after=0.5)
    write(sink, range(30))
    write(sink, range(30, 40), TOUCH)
    write(sink, range(40, 80))
    assert not sink.recording
    # A contact that comes back in time goes into the same file.
    write(sink, range(80, 83), TOUCH)
    write(sink, range(83, 86))
    write(sink, range(86, 88), TOUCH)
    sink.close()
    first, second = sorted(tmp_path.iterdir())
    # The ring holds 1 s = frames 19 to 29 (both ends count); 0.5 s after the last touch is frame 44.
    assert seqs_in(first) == [0, *range(19, 45)]
    assert seqs_in(second) == [0, *range(69, 88)]


def test_a_contact_that_was_stopped_by_hand_does_not_begin_again_by_itself(tmp_path: Path) -> None:
    sink = opened(tmp_path / "touch.mcap", trigger="contact")
    write(sink, range(1, 4), TOUCH)
    sink.stop_recording()
    write(sink, range(4, 8), TOUCH)
    assert not sink.recording
    write(sink, range(8, 10))
    write(sink, range(10, 12), TOUCH)
    assert sink.recording
    sink.close()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_ring_across_two_epochs_brings_the_references_of_the_older_one(tmp_path: Path) -> None:
    sink = opened(tmp_path / "ring.mcap", ring=1.0)
    for seq in range(30):
        frame = Frame(
            "main", seq, seq / FPS, image(seq), reference=seq in (0, 1, 25), epoch=1 if seq >= 25 else 0
        )
        sink.write(Result(frame))
    sink.start_recording()
    sink.close()
    frames = stored(tmp_path / "ring-001.mcap")
    assert [frame.seq for frame in frames] == [0, 1, *range(19, 30)]
    assert [frame.seq for frame in frames if frame.reference] == [0, 1, 25]
    assert [frame.epoch for frame in frames] == [0] * 8 + [1] * 5
    assert [frame.seq for frame in frames if not frame.paced] == [0, 1]


def test_a_ring_without_a_trigger_is_refused() -> None:
    with pytest.raises(ValidationError, match="set trigger to button or contact"):
        Record.Params(ring=30, trigger="start")


def messages_in(path: Path) -> list[tuple[str, int, bytes]]:
    """Topic, time and data of all that belongs to frames, without references that a file begins with."""
    with path.open("rb") as file:
        found = [(channel.topic, m.log_time, m.data) for _, channel, m in make_reader(file).iter_messages()]
    times = {"/main/frames": 0, "/main/references": 0}
    return [
        (topic, time, data)
        for topic, time, data in found
        if topic not in times or time == round(parse_frame(data).t * 1e9)
    ]


def test_a_recording_in_several_files_is_the_same_as_in_one(tmp_path: Path) -> None:
    whole, parts = opened(tmp_path / "whole.mcap"), opened(tmp_path / "part.mcap", rotate_after=0.5)
    for seq in range(21):
        # A new epoch begins in the middle.
        frame = Frame("main", seq, seq / FPS, image(seq), reference=seq in (0, 1, 11), epoch=int(seq >= 11))
        for sink in (whole, parts):
            sink.write(Result(frame))
    whole.close()
    parts.close()
    files = [tmp_path / "part.mcap", *sorted(tmp_path.glob("part-*.mcap"))]
    assert [path.name for path in files[1:3]] == ["part-001.mcap", "part-002.mcap"]
    lengths = [sum(topic == "/main/results" for topic, *_ in messages_in(path)) for path in files]
    assert lengths == [5, 5, 5, 5, 1]
    assert [m for path in files for m in messages_in(path)] == messages_in(tmp_path / "whole.mcap")
    assert parts.counters()["files"] == len(files)
    for path, begins in zip(files, np.cumsum([0, *lengths[:-1]]), strict=True):
        frames = stored(path)
        references = [0, 1] if begins <= 11 else [11]
        assert [frame.seq for frame in frames if frame.reference][: len(references)] == references
        assert frames[0].reference, "each file begins with the references of its first frame"


def test_a_contact_that_no_stage_gives_cannot_begin_a_recording(tmp_path: Path) -> None:
    file = tmp_path / "pipeline.yaml"
    file.write_text(
        "stages:\n  capture: {source: 'sim:press'}\nsinks:\n  record: {path: a.mcap, trigger: contact}\n"
    )
    with pytest.raises(ConfigError, match=r"sinks.record.trigger: contact needs contact"):
        load_pipeline(file)
