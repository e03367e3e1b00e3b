"""Live sources that come and go: a scripted device for each fault, whatever the time it takes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.sources import Watch, Watched
from tactflow.sources.watch import Arrival
from tactflow.stages.capture import Capture
from tests.clock import PATIENCE, until
from tests.sources.flaky import Flaky

QUICK = {
    "no_frame_timeout": None,
    "frozen_after": 0.1,
    "black_after": 0.1,
    "silent_after": 0.1,
    "hang_after": 0.2,
    "first_retry": 0.01,
    "last_retry": 0.04,
}
"""Short times on the device's clock, s: they bound nothing that really happens."""


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
        opened.append(Watched(device.open, Watch(**{**QUICK, **settings}), "flaky", device.clock))
        return opened[-1]

    yield watch
    device.free.set()
    for source in opened:
        source.close()


def capture_of(device: Flaky, **params: Any) -> Capture:
    """A capture of the device, watched with short times."""

    def opener(*_: object, watch: Watch, **__: object) -> Watched:
        settings = {**QUICK, "no_frame_timeout": watch.no_frame_timeout}
        return Watched(device.open, Watch(**settings), "flaky", device.clock)

    return Capture(Capture.Params.model_validate({"source": "0", **params}), opener=opener)


def take(source: Watched, count: int = 5) -> list[Arrival]:
    arrivals = [source.read_arrival() for _ in range(count)]
    assert None not in arrivals
    return [arrival for arrival in arrivals if arrival is not None]


def await_log(caplog: pytest.LogCaptureFixture, text: str) -> None:
    until(lambda: text in caplog.text, lambda: f"never said {text!r}: {caplog.text}")


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
        until(lambda: source.state.startswith("reconnecting since"), lambda: source.state)
        device.does = "good"
        await_log(caplog, "is back after")
        until(lambda: last.connection > 0)
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
        device.stamp = 0.0
        device.fail("ends", openings=2)
        connection = arrivals[-1].connection

        def again(connection: int = connection) -> bool:
            arrivals.extend(take(source))
            return arrivals[-1].connection > connection

        until(again)
    assert [a.seq for a in arrivals] == sorted({a.seq for a in arrivals})
    assert [a.t for a in arrivals] == sorted({a.t for a in arrivals})
    assert [a.connection for a in arrivals] == sorted(a.connection for a in arrivals)
    assert arrivals[-1].connection >= 3


def test_a_reader_that_is_slow_gets_the_newest_frame_and_a_gap_in_seq(
    watched: Callable[..., Watched],
) -> None:
    source = watched()
    first = take(source, 1)[0]
    before = source.missed
    until(lambda: source.missed >= before + 5)
    second = take(source, 1)[0]
    assert second.seq - first.seq >= 6


def test_capture_tells_how_many_frames_nobody_took(device: Flaky) -> None:
    capture = Capture(
        Capture.Params(source="0"),
        opener=lambda *_, **__: Watched(device.open, Watch(**QUICK), "flaky", device.clock),
    )
    capture.open()
    frames = capture.frames()
    seqs = [next(frames).seq]
    for wanted in (3, 6, 9):
        until(lambda wanted=wanted: capture.missed >= wanted)
        before = capture.missed
        seqs.append(next(frames).seq)
        # Of the frames up to this one, those that were not taken are gaps; more may have come meanwhile.
        assert before <= seqs[-1] + 1 - len(seqs) <= capture.missed
    capture.stop()
    capture.close()


@pytest.mark.parametrize(("settle", "looked_at"), [(0, 0), (3, 9)])
def test_the_first_frames_of_a_camera_are_only_looked_at_and_counted(
    device: Flaky, settle: float, looked_at: int
) -> None:
    capture = Capture(
        Capture.Params(source="0", settle=settle),
        opener=lambda *_, **__: Watched(device.open, Watch(**QUICK), "flaky", device.clock),
    )
    capture.open()
    frames = capture.frames()
    first, second = next(frames), next(frames)
    assert (first.reference, second.reference) == (True, False)
    assert second.seq >= first.seq + looked_at + 1
    assert capture.missed >= looked_at
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
    until(lambda: source.read_arrival() is None)
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
        until(lambda: source.read_arrival() is None)
        ended.set()

    threading.Thread(target=run).start()
    if does != "good":
        until(lambda: source.state != "running")
    source.stop()
    assert ended.wait(PATIENCE)


def test_every_connection_is_closed_again(device: Flaky, watched: Callable[..., Watched]) -> None:
    source = watched()
    take(source)
    device.does = "hangs"
    thread, _ = read_beside(source)
    until(lambda: device.opened >= 3)
    device.does = "good"
    thread.join(PATIENCE)
    device.free.set()
    source.close()
    until(lambda: device.closed == device.opened)


def test_capture_names_the_thread_that_frames_arrive_in_now(device: Flaky) -> None:
    capture = Capture(
        Capture.Params(source="0"),
        opener=lambda *_, **__: Watched(device.open, Watch(**QUICK), "flaky", device.clock),
    )
    assert capture.live_threads == []
    capture.open()
    frames = capture.frames()
    next(frames)
    (first,) = capture.live_threads
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    assert names[first] == "tactflow-read-flaky"
    device.fail("hangs", openings=2)
    until(lambda: next(frames) and capture.live_threads != [first])
    assert len(capture.live_threads) == 1, "the reader that hangs is not waited for any more"
    capture.stop()
    device.free.set()
    capture.close()


@pytest.mark.parametrize("on_reconnect", ["keep", "retake"])
def test_capture_keeps_or_retakes_the_reference_after_a_reconnection(
    on_reconnect: str, device: Flaky
) -> None:
    capture = capture_of(device, on_reconnect=on_reconnect, reference=2, skip=3)
    capture.open()
    frames: list[Frame] = []
    for frame in capture.frames():
        frames.append(frame)
        if len(frames) == 5:
            device.fail("ends", openings=2)
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
