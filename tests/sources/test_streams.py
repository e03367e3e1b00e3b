"""Network streams: motion JPEG over HTTP, from a server that comes and goes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.engine.errors import SourceError
from tactflow.sources import Watch, Watched, open_source
from tests.clock import PATIENCE, until
from tests.sources.flaky import Reading

Opens = Callable[..., Reading]


class Server:
    """A stream at `address`. does : good or silent. count : of frames that tell their index; None: noise."""

    def __init__(self) -> None:
        self.does = "good"
        self.count: int | None = None
        self.port = 0
        self._random = np.random.default_rng(0)
        self.start()
        self.address = f"http://127.0.0.1:{self.port}/stream"

    def start(self) -> None:
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path != "/stream":
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                index = 0
                while not stream.stopped.wait(0.02) and index != stream.count:
                    if stream.does != "silent":
                        self.wfile.write(stream.part(index))
                        index += 1

            def log_message(self, format: str, *args: object) -> None:
                pass

        class Quiet(ThreadingHTTPServer):
            def handle_error(self, request: object, client_address: object) -> None:
                """A reader that hangs up is expected."""

        self.stopped = threading.Event()
        self._server = Quiet(("127.0.0.1", self.port), Handler)
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def part(self, index: int) -> bytes:
        image = np.full((48, 64, 3), 40 * (index % 5 + 1), np.uint8)
        if self.count is None:
            image = self._random.integers(90, 110, (48, 64, 3), np.uint8)
        jpeg = cv2.imencode(".jpg", image)[1].tobytes()
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
        return head.encode() + jpeg + b"\r\n"

    def stop(self) -> None:
        """Hang up, and accept no more connections."""
        self.stopped.set()
        self._server.shutdown()
        self._thread.join(PATIENCE)
        self._server.server_close()


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.stop()


@pytest.fixture
def watched(server: Server) -> Iterator[Opens]:
    """Opens the stream, watched, and reads it in another thread."""
    opened: list[Reading] = []

    def read(**settings: Any) -> Reading:
        source = open_source(server.address, watch=Watch(**settings))
        assert isinstance(source, Watched)
        opened.append(Reading(source))
        return opened[-1]

    yield read
    for reading in opened:
        reading.stop()
        reading.source.close()


def test_a_stream_gives_its_frames_stamped_on_arrival(server: Server) -> None:
    server.count = 5
    source = open_source(server.address)
    assert source.live
    assert source.size == (64, 48)
    before = time.time()
    frames = list(iter(source.read, None))
    source.close()
    # JPEG of a flat picture: within 2 gray levels of what was drawn.
    levels = [int(image[24, 32, 0]) for image, _ in frames]
    assert levels == pytest.approx([40, 80, 120, 160, 200], abs=2)
    times = [t for _, t in frames]
    assert times == sorted(times)
    # 60 s: only to tell Unix time from the stream's own time stamps.
    assert abs(times[0] - before) < 60


def test_an_address_without_a_stream_is_an_error_without_the_password(
    server: Server, capfd: pytest.CaptureFixture[str]
) -> None:
    address = server.address.replace("stream", "nothing").replace("//", "//operator:secret@")
    with pytest.raises(SourceError, match="no stream can be opened") as raised:
        open_source(address)
    assert str(server.port) in str(raised.value)
    assert "secret" not in str(raised.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("does", "says"), [("gone", "is gone since"), ("silent", "no frames since")])
def test_a_stream_that_fails_is_reported_and_comes_back(
    does: str, says: str, server: Server, watched: Opens, caplog: pytest.LogCaptureFixture
) -> None:
    reading = watched()
    arrivals = reading.arrivals
    until(lambda: len(arrivals) > 10)
    if does == "gone":
        server.stop()
    server.does = does
    until(lambda: says in caplog.text and reading.source.state != "running", lambda: caplog.text)
    server.does = "good"
    if does == "gone":
        server.start()
    until(lambda: reading.source.state == "running")
    count = len(arrivals)
    until(lambda: len(arrivals) > count + 10)
    assert "is back after" in caplog.text
    assert [arrival.seq for arrival in arrivals] == sorted({arrival.seq for arrival in arrivals})
