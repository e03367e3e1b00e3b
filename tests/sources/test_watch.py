"""Live sources that come and go: a scripted device for each fault, whatever the time it takes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.sources.watch import Arrival, Watch, Watched
from tactflow.stages.capture import Capture
from tests.sources.flaky import Flaky

PATIENCE = 20.0
"""s; how long a test waits for what must happen."""

QUICK = {
    "no_frame_timeout": None,
    "frozen_after": 0.1,
    "black_after": 0.1,
    "silent_after": 0.1,
    "hang_after": 0.2,
    "first_retry": 0.01,
    "last_retry": 0.04,
}


@pytest.fixture
def device() -> Iterator[Flaky]:
    device = Flaky()
    yield device
    device.free.set()


@pytest.fixture
def watched(device: Flaky) -> Iterator[Callable[..., Watched]]:
    """Opens the device, watched with short times."""
    opened: list[Watched] = []

    def watch(**settings: Any) -> Watched:
        opened.append(Watched(device.open, Watch(**{**QUICK, **settings}), "flaky"))
        return opened[-1]

    yield watch
    device.free.set()
    for source in opened:
        source.close()


def take(source: Watched, count: int = 5) -> list[Arrival]:
    arrivals = [source.read_arrival() for _ in range(count)]
    assert None not in arrivals
    return [arrival for arrival in arrivals if arrival is not None]


def await_log(caplog: pytest.LogCaptureFixture, text: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while text not in caplog.text:
        assert time.monotonic() < deadline, f"never said {text!r}: {caplog.text}"
        time.sleep(0.01)


def read_beside(source: Watched) -> tuple[threading.Thread, list[Arrival]]:
    """Read in another thread, which ends with the first frame of a new connection or after a fault."""
    seen: list[Arrival] = []

    def run() -> None:
        arrival = source.read_arrival()
        if arrival is not None:
            seen.append(arrival)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, seen


FAULTS = [
    ("gone", "is gone", True),
    ("ends", "is gone", True),
    ("frozen", "the same picture bit for bit", True),
    ("black", "only black pictures", True),
    ("hangs", "delivers no frames", True),
]


@pytest.mark.parametrize(("does", "says", "reconnects"), FAULTS, ids=[fault[0] for fault in FAULTS])
def test_each_fault_is_reported_once_and_so_is_its_end(
    does: str,
    says: str,
    reconnects: bool,
    device: Flaky,
    watched: Callable[..., Watched],
    caplog: pytest.LogCaptureFixture,
) -> None:
    source = watched()
    before = take(source)
    assert source.state == "running"
    device.does = does
    # Frames go on until the fault shows; then the read waits.
    deadline = time.monotonic() + PATIENCE
    last = before[-1]
    stop = threading.Event()

    def run() -> None:
        nonlocal last
        while not stop.is_set() and (arrival := source.read_arrival()) is not None:
            last = arrival

    thread = threading.Thread(target=run)
    thread.start()
    try:
        await_log(caplog, says)
        while not source.state.startswith("reconnecting since"):
            assert time.monotonic() < deadline, source.state
            time.sleep(0.01)
        device.does = "good"
        await_log(caplog, "is back after")
        while last.connection == 0:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert source.state == "running"
    finally:
        stop.set()
        source.stop()
        thread.join(PATIENCE)
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 2, warnings
    assert reconnects == (device.opened > 1)


def test_seq_and_time_grow_across_reconnections_even_if_the_devices_clock_does_not(
    device: Flaky, watched: Callable[..., Watched]
) -> None:
    source = watched()
    arrivals = take(source)
    for _ in range(3):
        device.does = "ends"
        device.clock = 0.0
        thread, seen = read_beside(source)
        time.sleep(0.05)
        device.does = "good"
        thread.join(PATIENCE)
        arrivals += seen + take(source)
    assert [a.seq for a in arrivals] == sorted({a.seq for a in arrivals})
    assert [a.t for a in arrivals] == sorted({a.t for a in arrivals})
    assert [a.connection for a in arrivals] == sorted(a.connection for a in arrivals)
    assert arrivals[-1].connection >= 3


def test_a_reader_that_is_slow_gets_the_newest_frame_and_a_gap_in_seq(
    watched: Callable[..., Watched],
) -> None:
    source = watched()
    first = take(source, 1)[0]
    while source.missed < 5:
        time.sleep(0.01)
    second = take(source, 1)[0]
    assert second.seq - first.seq >= 6


def test_capture_tells_how_many_frames_nobody_took(device: Flaky) -> None:
    capture = Capture(
        Capture.Params(source="0"), opener=lambda *_, **__: Watched(device.open, Watch(**QUICK), "flaky")
    )
    capture.open()
    frames = capture.frames()
    seqs = [next(frames).seq]
    for wanted in (3, 6, 9):
        while capture.missed < wanted:
            time.sleep(0.01)
        before = capture.missed
        seqs.append(next(frames).seq)
        # Of the frames up to this one, those that were not taken are gaps; more may have come meanwhile.
        assert before <= seqs[-1] + 1 - len(seqs) <= capture.missed
    capture.stop()
    capture.close()


@pytest.mark.parametrize("does", ["gone", "hangs", "frozen", "black", "other_size"])
def test_without_a_good_frame_for_too_long_the_error_says_what_to_try(
    does: str, device: Flaky, watched: Callable[..., Watched]
) -> None:
    source = watched(no_frame_timeout=0.5)
    take(source)
    device.does = does
    with pytest.raises(SourceError, match=r"no good frame for .* no_frame_timeout") as raised:
        take(source, 10_000)
    if does == "gone":
        assert "nothing is plugged in" in str(raised.value)
    if does == "other_size":
        assert "32 x 24 pixels instead of 64 x 48" in str(raised.value)


def test_black_pictures_at_the_start_are_not_handed_over(
    device: Flaky, watched: Callable[..., Watched], caplog: pytest.LogCaptureFixture
) -> None:
    device.does = "black"
    source = watched()
    thread, seen = read_beside(source)
    await_log(caplog, "only black pictures")
    device.does = "good"
    thread.join(PATIENCE)
    assert seen[0].image.mean() > 50
    assert seen[0].seq > 0


@pytest.mark.parametrize(("does", "off"), [("black", "black_after"), ("frozen", "frozen_after")])
def test_a_check_of_pictures_can_be_switched_off(
    does: str, off: str, device: Flaky, watched: Callable[..., Watched], caplog: pytest.LogCaptureFixture
) -> None:
    # Switching off one must not leave the other: black pictures here differ, frozen ones are bright.
    source = watched(**{off: None})
    device.does = does
    take(source, 30)
    assert caplog.text == ""


def test_without_reconnection_a_device_that_stops_is_an_error(
    device: Flaky, watched: Callable[..., Watched]
) -> None:
    source = watched(reconnect=False)
    take(source)
    device.does = "gone"
    with pytest.raises(SourceError, match="delivers no more frames"):
        take(source, 100)
    assert device.opened == 1


def test_without_reconnection_a_stream_that_ends_is_the_end(
    device: Flaky, watched: Callable[..., Watched], caplog: pytest.LogCaptureFixture
) -> None:
    source = watched(reconnect=False)
    take(source)
    device.does = "ends"
    while source.read_arrival() is not None:
        pass
    assert "the stream ended after" in caplog.text
    assert device.opened == 1


def test_a_device_that_is_not_there_at_the_start_is_an_error_at_once() -> None:
    with pytest.raises(SourceError, match="nothing is plugged in"):
        Watched(Flaky("gone").open, Watch(no_frame_timeout=None), "flaky")


@pytest.mark.parametrize("does", ["good", "gone", "hangs"])
def test_stopping_ends_a_read_that_waits(does: str, device: Flaky, watched: Callable[..., Watched]) -> None:
    source = watched()
    take(source)
    device.does = does
    ended = threading.Event()

    def run() -> None:
        while source.read_arrival() is not None:
            pass
        ended.set()

    threading.Thread(target=run).start()
    time.sleep(0.05)
    source.stop()
    assert ended.wait(PATIENCE)


def test_every_connection_is_closed_again(device: Flaky, watched: Callable[..., Watched]) -> None:
    source = watched()
    take(source)
    device.does = "hangs"
    thread, _ = read_beside(source)
    while device.opened < 3:
        time.sleep(0.01)
    device.does = "good"
    thread.join(PATIENCE)
    device.free.set()
    source.close()
    deadline = time.monotonic() + PATIENCE
    while device.closed < device.opened:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_capture_names_the_thread_that_frames_arrive_in_now(device: Flaky) -> None:
    capture = Capture(
        Capture.Params(source="0"), opener=lambda *_, **__: Watched(device.open, Watch(**QUICK), "flaky")
    )
    assert capture.live_threads == []
    capture.open()
    frames = capture.frames()
    assert next(frames).seq == 0
    (first,) = capture.live_threads
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    assert names[first] == "tactflow-read-flaky"
    device.does = "hangs"
    threading.Timer(0.5, setattr, (device, "does", "good")).start()
    while capture.live_threads == [first]:
        next(frames)
    assert len(capture.live_threads) == 1, "the reader that hangs is not waited for any more"
    capture.stop()
    device.free.set()
    capture.close()


@pytest.mark.parametrize("on_reconnect", ["keep", "retake"])
def test_capture_keeps_or_retakes_the_reference_after_a_reconnection(
    on_reconnect: str, device: Flaky
) -> None:
    def opener(*_: object, watch: Watch, **__: object) -> Watched:
        # Only the fault that is made here shall be one: on a busy machine, silence comes by itself.
        patient = {**QUICK, "silent_after": PATIENCE, "hang_after": PATIENCE}
        return Watched(device.open, Watch(**{**patient, "no_frame_timeout": watch.no_frame_timeout}), "flaky")

    params = Capture.Params.model_validate(
        {"source": "0", "on_reconnect": on_reconnect, "reference": 2, "skip": 3}
    )
    capture = Capture(params, opener=opener)
    capture.open()
    frames: list[Frame] = []
    for frame in capture.frames():
        frames.append(frame)
        if len(frames) == 5:
            device.does = "ends"
            threading.Timer(0.1, setattr, (device, "does", "good")).start()
        if len(frames) == 10:
            capture.stop()
    capture.close()
    seqs = [frame.seq for frame in frames]
    assert seqs == sorted(set(seqs))
    assert seqs[0] >= 3
    assert [frame.reference for frame in frames[:4]] == [True, True, False, False]
    epochs = [frame.epoch for frame in frames]
    if on_reconnect == "keep":
        assert set(epochs) == {0}
        assert not any(frame.reference for frame in frames[2:])
    else:
        began = epochs.index(1)
        assert seqs[began] - seqs[began - 1] > 3, "frames are skipped again while the exposure settles"
        assert [frame.reference for frame in frames[began : began + 3]] == [True, True, False]
    assert capture.state == "running"
