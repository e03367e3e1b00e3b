"""Real network streams that come and go: HTTP motion JPEG and MPEG-TS over UDP, served by ffmpeg."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tactflow.engine.errors import SourceError
from tactflow.engine.frame import Frame
from tactflow.sources import Watch, Watched, open_source
from tactflow.sources.base import FrameReader
from tactflow.stages.capture import Capture
from tests.clock import LOOK_SECONDS, PATIENCE, ManualClock, until
from tests.sources.ffmpeg import DARKENS, FFMPEG, FREEZES, Server

pytestmark = pytest.mark.skipif(
    FFMPEG is None, reason="NO STREAM TESTS: ffmpeg is not installed (make system-deps installs it)"
)


def watched_by_hand(address: str, *, watch: Watch, **options: Any) -> Watched:
    """A stream that is watched by a clock on which time passes between two attempts to open it alone."""
    clock = ManualClock(pause=LOOK_SECONDS)
    return Watched(lambda: open_source(address, **options), watch, address, clock)


class Reading:
    """A capture of a stream, read in a thread of its own."""

    def __init__(
        self, server: Server, opener: Callable[..., FrameReader] = open_source, **params: object
    ) -> None:
        given = Capture.Params.model_validate({"source": server.address, **params})
        self.stage = Capture(given, opener=opener)
        until(self._opens, lambda: f"{server.address} cannot be opened")
        self.frames: list[Frame] = []
        self.error: SourceError | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _opens(self) -> bool:
        """Try it; the server needs a moment until it listens."""
        try:
            self.stage.open()
        except SourceError:
            return False
        return True

    def _run(self) -> None:
        try:
            self.frames.extend(self.stage.frames())
        except SourceError as error:
            self.error = error

    def more(self, count: int = 10) -> None:
        """Wait for so many more frames."""
        wanted = len(self.frames) + count
        self.until(lambda: len(self.frames) >= wanted)

    def until(self, condition: Callable[[], object]) -> None:
        until(condition, lambda: f"{len(self.frames)} frames, {self.stage.state}, {self.error}")

    def ended(self) -> bool:
        return not self._thread.is_alive()

    def close(self) -> None:
        self.stage.stop()
        self._thread.join(PATIENCE)
        self.stage.close()


@pytest.fixture
def servers() -> Iterator[list[Server]]:
    started: list[Server] = []
    yield started
    for server in started:
        server.kill()


def serve(servers: list[Server], *args: str) -> Server:
    servers.append(Server(*args))
    servers[-1].start()
    return servers[-1]


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.parametrize("kind", ["http", "udp"])
def test_a_server_that_is_killed_and_started_again_gives_frames_again(
    kind: str, servers: list[Server], caplog: pytest.LogCaptureFixture
) -> None:
    server = serve(servers, kind)
    reading = Reading(server)
    try:
        reading.more()
        server.kill()
        reading.until(lambda: reading.stage.state.startswith("reconnecting since"))
        server.start()
        reading.until(lambda: reading.stage.state == "running")
        reading.more()
    finally:
        reading.close()
    assert [frame.seq for frame in reading.frames] == sorted({frame.seq for frame in reading.frames})
    assert [frame.t for frame in reading.frames] == sorted({frame.t for frame in reading.frames})
    assert [frame.reference for frame in reading.frames[:2]] == [True, False]
    assert {frame.epoch for frame in reading.frames} == {0}
    said = warnings_of(caplog)
    assert "since" in said[0]
    assert any("is back after" in text for text in said)


def test_a_stream_that_is_interrupted_for_a_moment_is_reported_and_goes_on(
    servers: list[Server], caplog: pytest.LogCaptureFixture
) -> None:
    server = serve(servers, "udp")
    reading = Reading(server, on_reconnect="retake")
    try:
        reading.more()
        server.halt()
        reading.until(lambda: reading.stage.state != "running")
        server.resume()
        reading.until(lambda: reading.stage.state == "running")
        reading.more()
    finally:
        reading.close()
    assert "no frames since" in warnings_of(caplog)[0]


@pytest.mark.parametrize(("picture", "says"), [(FREEZES, "a frozen picture"), (DARKENS, "black pictures")])
def test_a_picture_that_freezes_or_turns_black_is_reported_and_not_handed_over(
    picture: str, says: str, servers: list[Server], caplog: pytest.LogCaptureFixture
) -> None:
    reading = Reading(serve(servers, "udp", picture), frozen_after=1.0, black_after=0.5)
    try:
        reading.until(lambda: any(says in text for text in warnings_of(caplog)))
        reading.until(lambda: reading.stage.state == "running")
        reading.more()
    finally:
        reading.close()
    assert any("is back after" in text for text in warnings_of(caplog))


def test_a_server_that_stays_away_ends_the_run_with_what_to_try(servers: list[Server]) -> None:
    server = serve(servers, "http")
    reading = Reading(server, watched_by_hand, no_frame_timeout=4.0)
    try:
        reading.more()
        server.kill()
        reading.until(reading.ended)
    finally:
        reading.close()
    assert reading.error is not None
    assert "no good frame for" in str(reading.error)
    assert "no stream can be opened there" in str(reading.error)


def test_without_reconnection_a_server_that_goes_away_is_the_end(servers: list[Server]) -> None:
    server = serve(servers, "http")
    reading = Reading(server, reconnect=False)
    try:
        server.kill()
        reading.until(reading.ended)
    finally:
        reading.close()
    assert reading.error is None
