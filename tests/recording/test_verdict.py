"""The verdict on a recording: what was lost is found, and what is right is good."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.cli.main import main
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.recording.course import Watcher, clipped_share
from tactflow.recording.verdict import Recorded, Verdict, examine_recording, extent, verdict_of
from tactflow.sinks.record import Record
from tests.terminal import Terminal

FPS = 30.0
COUNT = 300
RNG = np.random.default_rng(3)
LIGHT = np.linspace(60, 180, 64)[None, :, None]
NOISE = [(LIGHT + RNG.integers(-9, 10, (48, 64, 3))).astype(np.uint8) for _ in range(8)]
"""Pictures of one gel that differ by noise."""

Indices = NDArray[np.int64]
Times = NDArray[np.float64]


def verdict(
    seqs: Iterable[int], times: Iterable[float], *, stays: range = range(0), recorded: Recorded | None = None
) -> Verdict:
    """The verdict on frames of a gel. stays : frames that show the picture before them."""
    recorded = recorded or Recorded()
    watcher = Watcher()
    image = NOISE[0]
    for seq, t in zip(seqs, times, strict=True):
        image = image if seq in stays else NOISE[seq % len(NOISE)].copy()
        recorded.course.add(watcher.look(image, t, seq))
    return verdict_of(examine_recording(recorded), extent(recorded))


def steady(seqs: Indices) -> Times:
    return seqs / FPS


def jittering(seqs: Indices) -> Times:
    """Stamps on arrival: 4 ms of jitter, and now and then a frame that waits 20 ms for the processor."""
    delay = np.abs(np.random.default_rng(1).normal(0, 0.004, len(seqs)))
    delay[::37] += 0.02
    return steady(seqs) + delay


def dimming(seqs: Indices) -> Times:
    """A camera that halves its rate in the second half."""
    return np.cumsum(np.where(seqs < COUNT // 2, 1, 2)) / FPS


def slow(seqs: Indices) -> Times:
    """A clock that is set back by a second in the middle."""
    return steady(seqs) - (seqs > COUNT // 2)


def without(*lost: int) -> Indices:
    return np.delete(np.arange(COUNT), lost)


EVERY_OTHER = tuple(range(1, COUNT, 2))


@pytest.mark.parametrize("numbered", [True, False], ids=["numbers", "times alone"])
@pytest.mark.parametrize(
    ("seqs", "times", "word", "says"),
    [
        (without(), steady, "good", "300 frames in 10.0 s"),
        (without(), jittering, "good", "300 frames in 9.9 s"),
        (without(40), jittering, "good", "299 frames in 10.0 s"),
        (without(*range(7, 290, 23)), jittering, "usable", "13 of 300 frames missing"),
        (without(*range(100, 110)), jittering, "usable", "none for 36"),
        (without(*range(100, 160)), jittering, "bad", "none for 2.0 s from 3.3 s on"),
        (without(), dimming, "usable", "the rate changes between 15 and 30 frames/s"),
        (without(), slow, "usable", "the clock goes back 1 times"),
    ],
)
def test_lost_frames_and_uneven_times_are_found_and_jitter_is_not_a_fault(
    seqs: Indices, times: Callable[[Indices], Times], word: str, says: str, numbered: bool
) -> None:
    numbers = seqs if numbered else np.arange(len(seqs))
    found = verdict(numbers.tolist(), times(seqs).tolist())
    assert found.word == word, str(found)
    assert says in str(found)


def test_a_recording_of_every_other_frame_has_a_lower_rate_and_is_usable() -> None:
    seqs = without(*EVERY_OTHER)
    found = verdict(seqs.tolist(), steady(seqs).tolist())
    assert str(found) == "usable: 149 of 299 frames missing, 0 repeated"


@pytest.mark.parametrize(
    ("stays", "word", "says"),
    [
        (range(40, 42), "good", ""),
        (range(40, 50), "usable", "stands still for 333 ms from 1.3 s on"),
        (range(250, 300), "bad", "stands still for 1.7 s from 8.3 s to the end"),
        (range(1, 300), "bad", "all 300 pictures are the same"),
    ],
)
def test_a_sensor_that_stands_still_is_found(stays: range, word: str, says: str) -> None:
    found = verdict(range(COUNT), steady(np.arange(COUNT)).tolist(), stays=stays)
    assert found.word == word, str(found)
    assert says in str(found)


def test_a_film_whose_compression_repeats_pictures_at_rest_does_not_stand_still() -> None:
    recorded, watcher = Recorded(), Watcher()
    image = NOISE[0]
    for index in range(COUNT):
        image = NOISE[index % 8].copy() if index % 12 == 0 or index < COUNT // 2 else image
        recorded.course.add(watcher.look(image, index / FPS, index))
    assert recorded.course.frozen is None


def test_a_sensor_is_not_frozen_where_its_pictures_only_look_alike() -> None:
    watcher = Watcher()
    first = np.zeros((480, 640, 3), np.uint8)
    second = first.copy()
    second[1, 1] = 1
    assert [watcher.look(image, t, t).repeated for t, image in enumerate((first, second, second.copy()))] == [
        *(False, False),
        True,
    ]


def test_white_dots_are_not_clipped_and_a_white_border_is() -> None:
    pins = np.full((480, 640, 3), 20, np.uint8)
    pins[20::60, 20::60] = 255
    pins = np.maximum(pins, np.roll(pins, (3, 3), (0, 1)))
    bright = pins.copy()
    bright[:, 512:, 2] = 255
    assert clipped_share(pins[::10, ::10]) == 0
    assert clipped_share(bright[::10, ::10]) == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize(
    ("recorded", "text"),
    [
        (Recorded(stopped="the disk is damaged"), "bad: the disk is damaged"),
        (Recorded(remark="it was not finished"), "usable: it was not finished"),
        (Recorded(lacking=20), "usable: the file ends after 300 of 320 frames"),
        (Recorded(lacking=100), "bad: the file ends after 300 of 400 frames"),
        (Recorded(timed=False), "good: 300 pictures"),
    ],
)
def test_what_is_wrong_with_the_file_is_said(recorded: Recorded, text: str) -> None:
    found = verdict(range(COUNT), steady(np.arange(COUNT)).tolist(), recorded=recorded)
    assert str(found) == text


def test_the_wait_between_the_references_of_a_camera_and_its_next_frame_is_no_loss() -> None:
    recorded, watcher = Recorded(), Watcher()
    for seq in (12, 13, *range(60, 100)):
        recorded.course.add(watcher.look(NOISE[seq % 8], seq / FPS, seq, reference=seq < 14))
    assert str(verdict_of(examine_recording(recorded), extent(recorded))) == "good: 40 frames in 1.3 s"


def test_the_sink_counts_each_recording_by_itself_and_damaged_pictures(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "tactflow")
    sink = Record(Record.Params(path=str(tmp_path / "press.mcap"), trigger="button"))
    sink.open()
    sink.begin()
    for begin in (0, 500):
        sink.start_recording()
        for seq in range(begin, begin + 20):
            image, is_damaged = NOISE[seq % 8], seq in (505, 508)
            if seq == 508:
                image = np.zeros_like(image)
            sink.write(Result(Frame("main", seq, seq / FPS, image, damaged=is_damaged), {}))
        sink.stop_recording()
    sink.close()
    notes = [record.getMessage() for record in caplog.records]
    assert any(note.endswith("press-001.mcap is good: 20 frames in 633 ms") for note in notes)
    assert sink.verdict == (
        "bad: 1 of 20 pictures are damaged, the first is number 5; "
        "1 of 20 pictures show no gel, the first is number 8"
    )


def test_the_last_line_of_record_is_the_verdict_and_doctor_says_the_same(
    tmp_path: Path, terminal: Terminal
) -> None:
    out = tmp_path / "a.mcap"
    sinks = [word for name in ("zmq", "jsonl", "view") for word in ("--set", f"sinks.{name}=null")]
    command = ["record", "markerless", *sinks, "--out", str(out), "--overwrite"]
    for source, text in (
        ("sim:unmarked?frames=40", "good: 40 frames in 650 ms"),
        ("sim:unmarked?frames=40&lost=0.2", "usable: 8 of 40 frames missing, 0 repeated"),
        (
            "sim:unmarked?frames=40&frozen=20",
            "bad: the picture stands still for 333 ms from 0.3 s to",
        ),
    ):
        assert terminal(*command, "--source", source) == 0
        line = terminal.err.splitlines()[-1]
        assert line.startswith(text)
        assert terminal("doctor", str(out)) == (3 if text.startswith("bad") else 0)
        assert terminal.out.splitlines()[-1] == line
    assert main([*command, "--quiet", "--source", "sim:unmarked?frames=4"]) == 0
