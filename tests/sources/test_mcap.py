"""Recordings as a source: what was captured comes back, also from the middle, and again and again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.sinks.record import Record
from tactflow.sources import open_source
from tactflow.stages.capture import Capture

FPS = 10.0
UNIX = 1_700_000_000.123456789


def image(seq: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seq + 1000).integers(0, 256, (12, 17, 3), np.uint8)


def frames(seqs: Sequence[int], references: Sequence[int] = (0,), start: float = 0.0) -> list[Frame]:
    """A new epoch begins at each reference that does not follow another one directly."""
    made, epoch = [], 0
    for seq in seqs:
        epoch += seq in references and seq > 0 and seq - 1 not in references
        t = start + max(seq, 0) / FPS
        made.append(Frame("main", seq, t, image(seq), 0.0, seq in references or seq < 0, epoch))
    return made


def record(path: Path, made: Sequence[Frame], *, cut: bool = False) -> Path:
    sink = Record(Record.Params(path=str(path), preview=0))
    sink.open()
    sink.begin()
    for frame in made:
        sink.write(Result(frame))
    if cut:
        data = path.read_bytes()
        sink.close()
        path.write_bytes(data)
    else:
        sink.close()
    return path


def captured(spec: Path | str, **params: Any) -> list[Frame]:
    capture = Capture(Capture.Params(source=str(spec), **params))
    capture.open()
    try:
        return list(capture.frames())
    finally:
        capture.close()


def facts(made: Sequence[Frame]) -> list[tuple[int, float, bool, int]]:
    return [(frame.seq, frame.t, frame.reference, frame.epoch) for frame in made]


def same(one: Sequence[Frame], other: Sequence[Frame]) -> None:
    assert facts(one) == facts(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.image, b.image)


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("start", [0.0, UNIX])
def test_frames_come_back_with_seq_time_and_flags_as_they_were(
    tmp_path: Path, cut: bool, start: float, caplog: pytest.LogCaptureFixture
) -> None:
    made = frames([0, 1, 2, 5, 6, 9, 10, 11], references=(0, 1, 9, 10), start=start)
    path = record(tmp_path / "what?.mcap", made, cut=cut)
    # As of a video that ends early: an export or a batch shows warnings alone.
    caplog.set_level("WARNING")
    # What capture is told about references and frames to skip was true of the camera, not of this file.
    found = captured(path, reference=4, skip=3)
    same(found, made)
    assert not found[0].image.flags.writeable
    assert ("was not finished" in caplog.text) == ("tactflow repair" in caplog.text) == cut


def test_a_recording_says_how_long_and_how_fast_it_is(tmp_path: Path) -> None:
    source = open_source(str(record(tmp_path / "a.mcap", frames(range(21)))))
    assert source.stamped
    assert (source.live, source.total, source.size) == (False, 21, (17, 12))
    assert source.fps == pytest.approx(FPS, rel=1e-9)
    assert "21 frames" in source.description


@pytest.mark.parametrize("cut", [False, True])
def test_start_skips_ahead_but_shows_the_references_that_are_in_force(tmp_path: Path, cut: bool) -> None:
    made = frames(range(40), references=(0, 1, 20, 21))
    path = record(tmp_path / "a.mcap", made, cut=cut)
    same(captured(f"{path}?start=1.0"), [*made[:2], *made[10:]])
    same(captured(f"{path}?start=3"), [*made[20:22], *made[30:]])
    # In the middle of the references: those before, then the others in their turn.
    same(captured(f"{path}?start=2.1"), [made[20], *made[21:]])
    with pytest.raises(SourceError, match="no frame after 4 s"):
        captured(f"{path}?start=4")


def test_a_new_reference_can_be_taken_during_replay(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", frames(range(8), references=(0, 5)))
    capture = Capture(Capture.Params(source=str(path), reference=2))
    capture.open()
    found = []
    for frame in capture.frames():
        found.append((frame.seq, frame.reference, frame.epoch))
        if frame.seq == 1:
            capture.retake()
    capture.close()
    assert [seq for seq, reference, _ in found if reference] == [0, 2, 3, 5]
    assert [epoch for _, _, epoch in found] == [0, 0, 1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize("query", ["start=-1", "start=soon", "start=1e300", "start=nan", "speed=2"])
def test_a_wrong_option_is_a_clear_error(tmp_path: Path, query: str) -> None:
    path = record(tmp_path / "a.mcap", frames(range(3)))
    with pytest.raises(SourceError, match=f"{query}: required start=SECONDS"):
        open_source(f"{path}?{query}")


def test_files_of_others_are_refused_with_what_they_hold(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.mcap"
    writer = Writer(str(foreign))
    writer.start()
    schema = writer.register_schema("std_msgs/String", "ros1msg", b"string data")
    channel = writer.register_channel("/chatter", "ros1", schema)
    writer.add_message(channel, 0, b"\0\0\0\0", 0)
    writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(SourceError, match=r"no topic holds pictures; there are /chatter \(std_msgs"):
        open_source(str(foreign))
    text = tmp_path / "text.mcap"
    for content in (b"", b"hello, I am no recording"):
        text.write_bytes(content)
        with pytest.raises(SourceError, match="is not an MCAP file"):
            open_source(str(text))
    with pytest.raises(SourceError, match=r"no such file.*did you mean .*foreign"):
        open_source(str(tmp_path / "foreing.mcap"))
    with pytest.raises(SourceError, match="no frame in it"):
        open_source(str(record(tmp_path / "empty.mcap", [])))
    (tmp_path / "folder.mcap").mkdir()
    with pytest.raises(SourceError, match="cannot be read"):
        open_source(str(tmp_path / "folder.mcap"))
