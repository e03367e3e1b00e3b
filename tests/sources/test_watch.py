"""Live sources that fail and come back: a scripted device for each fault, however long it takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.sources import Arrival, Watch, Watched
from tactflow.stages.capture import Capture
from tests.clock import until
from tests.sources.flaky import Flaky, Reading

Opens = Callable[..., Watched]
Captures = Callable[..., Capture]
QUICK = {
    "no_frame_timeout": None,
    "frozen_after": 0.1,
    "black_after": 0.1,
    "silent_after": 0.1,
    "retry": 0.01,
}
"""Short times on the device's clock, s: they bound nothing that really happens."""


@pytest.fixture
def device() -> Iterator[Flaky]:
    device = Flaky()
    yield device
    device.free.set()


@pytest.fixture
def watched(device: Flaky) -> Iterator[Opens]:
    """Opens the device, watched with short times."""
    opened: list[Watched] = []

    def watch(**settings: Any) -> Watched:
        opened.append(Watched(device.open, Watch(**{**QUICK, **settings}), "flaky", device.clock))
        return opened[-1]

    yield watch
    device.free.set()
    for source in opened:
        source.close()


@pytest.fixture
def capture(watched: Opens) -> Iterator[Captures]:
    """Opens a capture of the device, watched with short times."""
    opened: list[Capture] = []

    def start(**params: Any) -> Capture:
        parameters = Capture.Params.model_validate({"source": "0", **params})
        opened.append(Capture(parameters, opener=lambda *_, **__: watched()))
        opened[-1].open()
        return opened[-1]

    yield start
    for stage in opened:
        stage.stop()


def take(source: Watched, count: int = 5) -> list[Arrival]:
    arrivals = [source.read_arrival() for _ in range(count)]
    assert None not in arrivals
    return [arrival for arrival in arrivals if arrival is not None]


def test_seq_and_time_grow_across_reconnections_even_if_the_devices_clock_does_not(
    device: Flaky, watched: Opens
) -> None:
    source = watched()
    arrivals = take(source)
    for opened in (3, 5, 7):
        device.stamp = 0.0
        device.fail("ends", openings=2)
        while device.opened < opened:
            arrivals.extend(take(source))
    arrivals.extend(take(source))
    assert [a.seq for a in arrivals] == sorted({a.seq for a in arrivals})
    assert [a.t for a in arrivals] == sorted({a.t for a in arrivals})


def test_a_reader_that_is_slow_gets_the_newest_frame_and_a_gap_in_seq(watched: Opens) -> None:
    source = watched()
    first = take(source, 1)[0]
    before = source.missed
    until(lambda: source.missed >= before + 5)
    assert take(source, 1)[0].seq - first.seq >= 6


def test_black_pictures_at_the_start_are_not_handed_over(
    device: Flaky, watched: Opens, caplog: pytest.LogCaptureFixture
) -> None:
    device.does = "black"
    source = watched()
    reading = Reading(source)
    until(lambda: "black pictures" in caplog.text)
    device.does = "good"
    until(lambda: reading.arrivals)
    reading.stop()
    assert reading.arrivals[0].image.mean() > 50
    assert reading.arrivals[0].seq > 0


def test_a_short_dark_moment_after_light_is_passed_on(
    device: Flaky, watched: Opens, caplog: pytest.LogCaptureFixture
) -> None:
    source = watched(black_after=1e6, frozen_after=None)
    take(source)
    device.does = "black"
    assert take(source, 10)[-1].image.mean() < 4
    assert caplog.text == ""


@pytest.mark.parametrize(("does", "off"), [("black", "black_after"), ("frozen", "frozen_after")])
def test_a_check_of_pictures_can_be_switched_off(
    does: str, off: str, device: Flaky, watched: Opens, caplog: pytest.LogCaptureFixture
) -> None:
    # Switching off one must not leave the other: black pictures here differ, frozen ones are bright.
    source = watched(**{off: None})
    device.does = does
    take(source, 30)
    assert caplog.text == ""


def test_without_reconnection_a_camera_that_stops_is_an_error_and_a_stream_that_ends_is_the_end(
    device: Flaky, watched: Opens, caplog: pytest.LogCaptureFixture
) -> None:
    source = watched(reconnect=False)
    take(source)
    device.does = "gone"
    with pytest.raises(SourceError, match="delivers no more frames"):
        take(source, 100)
    device.does = "good"
    source = watched(reconnect=False)
    take(source)
    device.does = "ends"
    until(lambda: source.read_arrival() is None)
    assert "the stream ended after" in caplog.text
    assert device.opened == 2


def test_a_device_that_is_not_there_at_the_start_is_an_error_at_once() -> None:
    with pytest.raises(SourceError, match="nothing is plugged in"):
        Watched(Flaky("gone").open, Watch(no_frame_timeout=None), "flaky")


def test_a_device_that_hangs_is_an_error_once_patience_ends(device: Flaky, watched: Opens) -> None:
    source = watched(no_frame_timeout=0.5)
    take(source)
    device.does = "hangs"
    with pytest.raises(SourceError, match="no frames, no good frame for"):
        take(source, 100)


@pytest.mark.parametrize("does", ["good", "gone", "hangs"])
def test_stopping_ends_a_read_that_waits(does: str, device: Flaky, watched: Opens) -> None:
    source = watched()
    take(source)
    device.does = does
    reading = Reading(source)
    if does != "good":
        until(lambda: source.state != "running")
    reading.stop()


def test_every_connection_is_closed_again(device: Flaky, watched: Opens) -> None:
    source = watched()
    reading = Reading(source)
    device.fail("ends", openings=3)
    until(lambda: device.opened >= 3 and source.state == "running")
    reading.stop()
    source.close()
    assert device.closed == device.opened


def test_capture_counts_frames_that_nobody_took_or_that_were_only_looked_at(capture: Captures) -> None:
    stage = capture(settle=0)
    frames = stage.frames()
    seqs = [next(frames).seq]
    for wanted in (3, 6, 9):
        until(lambda wanted=wanted: stage.missed >= wanted)
        before = stage.missed
        seqs.append(next(frames).seq)
        # Of the frames up to this one, those that were not taken are gaps; more may have come meanwhile.
        assert before <= seqs[-1] + 1 - len(seqs) <= stage.missed
    stage = capture(settle=3)
    frames = stage.frames()
    first, second = next(frames), next(frames)
    assert (first.reference, second.reference) == (True, False)
    assert second.seq - first.seq > 9
    assert stage.missed >= 9


def test_capture_keeps_its_reference_after_a_reconnection(device: Flaky, capture: Captures) -> None:
    stage = capture(reference=2, skip=3)
    frames: list[Frame] = []
    for frame in stage.frames():
        frames.append(frame)
        if len(frames) == 5:
            device.fail("ends", openings=2)
        if len(frames) > 5 and device.opened == 3:
            stage.stop()
    seqs = [frame.seq for frame in frames]
    assert seqs == sorted(set(seqs))
    assert seqs[0] >= 3
    assert [frame.reference for frame in frames] == [True, True, *[False] * (len(frames) - 2)]
    assert {frame.epoch for frame in frames} == {0}
    assert stage.state == "running"
