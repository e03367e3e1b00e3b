"""The view as its pages see it: real sockets, no browser."""

from __future__ import annotations

import http.client
import json
import logging
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tactflow.config.load import load_pipeline
from tactflow.engine.contract import Source, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Frame, Tick
from tactflow.engine.run import Runner
from tactflow.network.address import is_loopback
from tactflow.sinks.view import View
from tactflow.view import server
from tactflow.view.address import address, bind
from tactflow.vision.flow import FieldModel
from tactflow.vision.types import Contact, Depth, Markers, Scale
from tests.clock import PATIENCE, until
from tests.messages import Results, build_message, result_of

SECRET = "a-secret-of-some-length"


class FakeSource(Source):
    """A source that is as the test wants it."""

    total = 600
    description = "a test"
    words = "running"

    @property
    def state(self) -> str:
        return self.words

    def retake(self) -> None: ...


class FakeRun:
    """A run that notes what it is asked to do."""

    def __init__(self, *, live: bool = False, recorder: Any = None) -> None:
        self.calls: list[Any] = []
        self.paused = False
        self.source = FakeSource(StageParams())
        self.source.live = live
        self.sink = recorder

    def recorder(self) -> Any:
        return self.sink

    def stop(self, reason: str = "signal") -> None:
        self.calls.append(("stop", reason))

    def pause(self, paused: bool) -> None:
        self.paused = paused
        self.calls.append(("pause", paused))

    def step(self) -> None:
        self.calls.append("step")

    def retake_reference(self) -> None:
        self.calls.append("reference")

    def snapshot(self) -> dict[str, Any]:
        return {"frames": 3, "end": "eos", "stages": {}, "sinks": {}, "links": {}}


class FakeRecorder:
    """A sink that can record."""

    def __init__(self) -> None:
        self.recording = False

    def start_recording(self) -> None:
        self.recording = True

    def stop_recording(self) -> None:
        self.recording = False


class Page:
    """A page of our own, without a browser."""

    def __init__(self, url: str, stack: ExitStack, **options: Any) -> None:
        host = url.removeprefix("http://").partition("/")[0]
        # A machine may be as slow as it likes.
        options = {"origin": f"http://{host}", "open_timeout": PATIENCE, "ping_timeout": None} | options
        path = options.pop("path", "live")
        self.socket: ClientConnection = stack.enter_context(
            connect(f"ws://{host}/{path}", compression=None, **options)
        )

    def next(self, kind: str, timeout: float = PATIENCE) -> Any:
        """The next message of a kind, others are passed over: frames as (header, jpeg)."""
        deadline = time.monotonic() + timeout
        while True:
            data = self.socket.recv(max(0.0, deadline - time.monotonic()))
            if isinstance(data, bytes):
                if kind == "frame":
                    (length,) = struct.unpack_from("<I", data)
                    return json.loads(data[4 : 4 + length]), data[4 + length :]
            else:
                message = json.loads(data)
                if message["type"] == kind:
                    return message

    def until(self, kind: str, condition: Callable[[Any], bool]) -> Any:
        """The next message of a kind for which something holds."""
        while not condition(message := self.next(kind)):
            pass
        return message

    def say(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def close_code(self) -> int | None:
        """How the server ended the connection."""
        try:
            while True:
                self.socket.recv(PATIENCE)
        except ConnectionClosed:
            return self.socket.close_code


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Closes what a test opened, last first."""
    with ExitStack() as opened:
        yield opened


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server gets as long as it takes to start and to end."""
    monkeypatch.setattr(server, "START_SECONDS", PATIENCE)
    monkeypatch.setattr(server, "CLOSE_SECONDS", PATIENCE)


@pytest.fixture
def view(stack: ExitStack) -> Callable[..., View]:
    """Makes opened views on free ports."""

    def make(control: Any = None, **params: Any) -> View:
        sink = View(
            View.Params(**{"port": 0, "max_fps": 240.0} | params), "main", control=control or FakeRun()
        )
        stack.callback(sink.close)
        sink.open()
        return sink

    return make


@pytest.fixture
def page(stack: ExitStack) -> Callable[..., Page]:
    """Opens pages of a view."""

    def make(sink: View, **options: Any) -> Page:
        assert sink.description is not None
        return Page(sink.description, stack, **options)

    return make


def picture(width: int = 60, height: int = 80) -> NDArray[np.uint8]:
    """A smooth picture, which JPEG keeps well."""
    ramp = np.linspace(0, 255, width * height).reshape(height, width)
    return np.stack([ramp, ramp[::-1], ramp[:, ::-1]], axis=2).astype(np.uint8)


def tick(seq: int = 0) -> Tick:
    frame = Frame("main", seq, seq / 60, picture(), time.perf_counter())
    return Tick(frame, skipped={"contact": "no_contact"})


def write(sink: View, seq: int) -> None:
    """Have a frame shown, as the engine does: when the sink wants one."""
    until(sink.wants)
    sink.write(result_of(tick(seq), Results(picture(), None, None, None)))


# -- what pages are sent ------------------------------------------------------------------------------------


def test_without_a_page_nothing_is_wanted_and_nothing_encoded(view: Callable[..., View]) -> None:
    sink = view()
    assert not sink.wants()
    sink.write(result_of(tick(), Results(picture(), None, None, None)))
    assert sink.counters()["encoded"] == 0


def test_a_page_gets_the_plain_picture_and_the_result_message(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view(quality=95)
    browser = page(sink)
    assert browser.next("hello")["sensors"] == ["main"]
    write(sink, 7)
    header, jpeg = browser.next("frame")
    sent = tick(7)
    assert header["message"] == build_message(sent, Results(picture(), None, None, None), detail=True)
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    # Measured: a mean of 1.0 grey level at quality 95; a picture that was drawn on, or another one, has tens.
    assert np.abs(shown.astype(int) - picture()).mean() < 3
    assert header["latency_ms"] >= 0


def test_a_page_is_sent_nothing_more_until_it_has_drawn(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    browser = page(sink)
    write(sink, 0)
    first, _ = browser.next("frame")
    until(lambda: not sink.wants())
    sink.write(result_of(tick(1), Results(picture(), None, None, None)))
    assert sink.counters()["encoded"] == 1
    browser.say(ack=first["number"])
    write(sink, 2)
    assert browser.next("frame")[0]["message"]["seq"] == 2


def test_a_slow_page_gets_the_newest_frame_and_holds_up_nobody(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    fast, slow = page(sink), page(sink)
    for browser in (fast, slow):
        browser.next("hello")
    until(lambda: sink.counters()["pages"] == 2)
    held: Any = None
    for seq in range(10):
        write(sink, seq)
        header, _ = fast.next("frame")
        assert header["message"]["seq"] == seq
        fast.say(ack=header["number"])
        held = held or slow.next("frame")[0]
    assert held["message"]["seq"] == 0
    slow.say(ack=held["number"])
    assert slow.next("frame")[0]["message"]["seq"] == 9


def test_a_page_that_reads_nothing_holds_up_neither_writing_nor_closing(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    # It says that it drew, but its receive buffer is full and stays so.
    deaf = page(sink, max_queue=1, close_timeout=0.1)
    fast = page(sink)
    until(lambda: sink.counters()["pages"] == 2)
    noise = np.random.default_rng(1).integers(0, 256, (800, 800, 3)).astype(np.uint8)
    for number in range(1, 60):
        until(sink.wants)
        sink.write(result_of(tick(number), Results(noise, None, None, None)))
        fast.say(ack=fast.next("frame")[0]["number"])
        deaf.say(ack=number)
    assert fast.next("stats")["run"]["frames"] == 3
    sink.close()
    assert not any(thread.name == "tactflow-view-server" for thread in threading.enumerate())


def test_max_fps_bounds_what_is_encoded(view: Callable[..., View], page: Callable[..., Page]) -> None:
    sink = view(max_fps=1e-6)
    browser = page(sink)
    write(sink, 0)
    browser.say(ack=browser.next("frame")[0]["number"])
    until(lambda: "screen_p50_ms" in sink.counters())
    # The page is ready, but the next frame is due in six days.
    assert not sink.wants()
    sink.write(result_of(tick(1), Results(picture(), None, None, None)))
    assert sink.counters()["encoded"] == 1


def test_a_large_picture_is_reduced_and_its_coordinates_are_not(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view(max_size=64)
    browser = page(sink)
    until(sink.wants)
    sink.write(result_of(tick(), Results(picture(100, 200), None, None, None)))
    header, jpeg = browser.next("frame")
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (64, 32, 3)
    assert header["message"]["size"] == [100, 200]


def test_without_a_processed_image_the_raw_one_is_shown(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    browser = page(sink)
    until(sink.wants)
    sink.write(result_of(tick(), Results()))
    assert browser.next("frame")[0]["message"]["size"] == [60, 80]


def test_a_page_that_comes_late_to_a_paused_run_sees_the_last_picture(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    run = FakeRun()
    sink = view(run)
    first = page(sink)
    write(sink, 5)
    first.next("frame")
    run.pause(True)
    assert page(sink).next("frame")[0]["message"]["seq"] == 5


def test_a_frame_that_was_under_way_is_not_taken_for_that_of_a_step(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    run = FakeRun()
    run.paused = True
    sink = view(run)
    browser = page(sink)
    browser.next("hello")
    under_way = tick(0)
    browser.say(do="step")
    until(lambda: run.calls == ["step"])
    sink.write(result_of(under_way, Results(picture())))
    header, _ = browser.next("frame")
    assert sink.wants()
    sink.write(result_of(tick(1), Results(picture())))
    assert not sink.wants()
    browser.say(ack=header["number"])
    assert browser.next("frame")[0]["message"]["seq"] == 1


def test_field_and_heights_are_sent_only_while_a_page_shows_them(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    origin = np.array([[10.0, 10], [50, 10], [10, 70], [50, 70]])
    markers = Markers(origin, origin + np.array([2, 0]), np.zeros(4, np.uint8), np.full(4, 0.02))
    heights = np.zeros((80, 60), np.float32)
    heights[20:40, 10:50] = np.linspace(0.1, 0.5, 40)
    found = Results(
        picture(),
        scale=Scale(0.1, 0.2, (0, 0), (30, 40)),
        depth=Depth(heights, 0.5, None, 1.0, None),
        field=FieldModel(origin, (60, 80))(markers),
    )
    run = FakeRun()
    sink = view(run)
    browser, _ = page(sink), page(sink)

    def shown(seq: int) -> tuple[Any, bytes]:
        until(sink.wants)
        sink.write(result_of(tick(seq), found))
        return answered()

    def answered() -> tuple[Any, bytes]:
        header, data = browser.next("frame")
        browser.say(ack=header["number"])
        return header, data

    header, jpeg = shown(1)
    assert (header["field"], header["surface"], header["scale"]) == (True, True, [0.1, 0.2])
    assert jpeg[:2] == b"\xff\xd8"
    browser.say(show=["surface", "/etc/passwd", 7])
    until(lambda: sink._hub is not None and sink._hub.shown == {"surface"})
    header, data = shown(2)
    said = header["surface"]
    assert header["field"] is True
    assert said["box"] == [10, 20, 40, 20]
    assert data[said["bytes"] :][:2] == b"\xff\xd8"
    cells = np.frombuffer(data[: said["bytes"]], "<u2").reshape(said["size"][::-1]) * said["step"]
    middle = heights[20:40, 10:50].reshape(10, 2, 20, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(cells, middle, atol=said["step"])
    # No further frame comes while the run is paused: the last one comes again.
    run.pause(True)
    browser.say(show=["field"])
    header, _ = answered()
    assert header["message"]["seq"] == 2
    assert header["surface"] is True
    assert np.ptp(np.subtract(header["field"]["position"], header["field"]["origin"])[::2]) <= 10
    browser.say(show="field")
    until(lambda: sink._hub is not None and not sink._hub.shown)
    # A page that has shown what it was sent is told more.
    browser.next("stats")


# -- what pages may ask for ---------------------------------------------------------------------------------


@pytest.mark.parametrize("state", ["running", "waiting since 12:00:00 (no frames)"])
def test_a_source_that_is_held_is_not_said_to_run(
    state: str, view: Callable[..., View], page: Callable[..., Page]
) -> None:
    run = FakeRun()
    run.source.words = state
    browser = page(view(run))
    assert browser.next("state")["source"]["state"] == state
    browser.say(do="pause", value=True)
    held = browser.until("state", lambda told: told["paused"])["source"]["state"]
    assert held == ("paused" if state == "running" else state), "a fault is told even then"
    browser.say(do="pause", value=False)
    assert browser.until("state", lambda told: not told["paused"])["source"]["state"] == state


def test_buttons_reach_the_run_and_every_page_learns_of_it(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    run = FakeRun()
    sink = view(run)
    one, other = page(sink), page(sink)
    other.next("state")
    one.say(do="pause", value=True)
    assert other.until("state", lambda state: state["paused"])["refused"]["step"] is None
    one.say(do="step")
    one.say(do="reference")
    one.say(do="pause", value=False)
    other.until("state", lambda state: not state["paused"])
    one.say(do="stop")
    until(lambda: len(run.calls) == 5)
    assert run.calls == [("pause", True), "step", "reference", ("pause", False), ("stop", "signal")]


@pytest.mark.parametrize(
    ("live", "message", "words"),
    [
        (False, {"do": "step"}, "pause first"),
        (True, {"do": "step"}, "live source"),
        (False, {"do": "record", "value": True}, "no record sink"),
        (False, {"do": "read", "value": "/etc/passwd"}, "no command"),
        (False, {"do": "undo"}, "no command"),
        (False, {"do": ["pause"]}, "no command"),
        (False, {}, "no command"),
    ],
)
def test_what_is_not_possible_is_refused_with_a_reason(
    live: bool, message: dict[str, Any], words: str, view: Callable[..., View], page: Callable[..., Page]
) -> None:
    run = FakeRun(live=live)
    browser = page(view(run))
    browser.say(**message)
    assert words in browser.next("note")["text"]
    assert run.calls == []


def test_a_record_sink_in_the_run_is_started_and_stopped(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    recorder = FakeRecorder()
    browser = page(view(FakeRun(recorder=recorder)))
    assert browser.next("state")["refused"]["record"] is None
    browser.say(do="record", value=True)
    browser.until("state", lambda state: state["recording"])
    assert recorder.recording
    browser.say(do="record", value=False)
    browser.until("state", lambda state: not state["recording"])
    assert not recorder.recording


def test_a_failing_recorder_is_reported_and_ends_nothing(
    view: Callable[..., View], page: Callable[..., Page], caplog: pytest.LogCaptureFixture
) -> None:
    class Full(FakeRecorder):
        def start_recording(self) -> None:
            raise OSError("no space left")

    browser = page(view(FakeRun(recorder=Full())))
    browser.say(do="record", value=True)
    assert "no space left" in browser.next("note")["text"]
    assert "no space left" in caplog.text
    browser.next("stats")


def test_a_page_that_guides_is_told_what_to_do_and_can_undo(
    stack: ExitStack, page: Callable[..., Page]
) -> None:
    class Session:
        state: Mapping[str, Any] = {"now": "Press the ball"}
        undone = 0

        def undo(self) -> None:
            self.undone += 1

    session = Session()
    sink = View.through(session)(View.Params(port=0, max_fps=240.0), "main", control=FakeRun())
    stack.callback(sink.close)
    sink.open()
    browser = page(sink)
    write(sink, 1)
    assert browser.next("frame")[0]["guide"] == {"now": "Press the ball"}
    browser.say(do="undo")
    until(lambda: session.undone == 1)
    assert View.session is None


def test_junk_ends_that_page_and_no_other(view: Callable[..., View], page: Callable[..., Page]) -> None:
    sink = view()
    good = page(sink)
    for junk in ("", "not json", "[]", "7", '"' + "x" * 8000 + '"'):
        bad = page(sink)
        bad.socket.send(junk)
        assert bad.close_code() in (1008, 1009), junk
    write(sink, 0)
    assert good.next("frame")[0]["message"]["seq"] == 0


def test_an_answer_for_another_frame_counts_for_nothing(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    browser = page(sink)
    write(sink, 0)
    browser.next("frame")
    for number in (0, 2, -1, None, "1"):
        browser.say(ack=number)
    browser.say(do="nothing")
    browser.next("note")
    assert not sink.wants()


def test_a_page_on_a_full_machine_rests_before_its_next_frame(
    view: Callable[..., View], page: Callable[..., Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactflow.view.hub.REST_MS", 3_600_000)
    # The frame is shown to the other page, however late it comes.
    monkeypatch.setattr("tactflow.view.hub.STALE_SECONDS", PATIENCE)
    sink = view()
    browser = page(sink)
    write(sink, 0)
    number = browser.next("frame")[0]["number"]
    browser.say(ack=number, rest=3_600_000)
    # Saying it twice does not shorten the rest.
    browser.say(ack=number, rest=0)
    browser.say(do="nothing")
    browser.next("note")
    assert not sink.wants()
    # A frame for another page is no frame for this one.
    other = page(sink)
    other.say(ack=other.next("frame")[0]["number"])
    write(sink, 1)
    assert other.next("frame")[0]["message"]["seq"] == 1


def test_a_rest_is_never_long(view: Callable[..., View], page: Callable[..., Page]) -> None:
    sink = view()
    browser = page(sink)
    write(sink, 0)
    browser.say(ack=browser.next("frame")[0]["number"], rest=3_600_000)
    write(sink, 1)
    assert browser.next("frame")[0]["message"]["seq"] == 1


def test_what_is_only_drawn_is_sent_in_tenths_of_a_pixel(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    browser = page(sink)
    hull = np.array([[10.04, 20.06], [30.0, 20.0], [30.0, 40.0]])
    contact = Contact(200.123456, (23.3, 26.7), None, None, hull, None)
    origin = np.array([[1.04, 2.06], [-3.14159, 40.0], [5.0, 6.0]])
    markers = Markers(origin, origin + 0.5, np.array([0, 1, 2], np.uint8), np.full(3, np.nan))
    until(sink.wants)
    sink.write(result_of(tick(), Results(picture(), contact, None, markers)))
    header, _ = browser.next("frame")
    assert header["markers"] == {
        "origin": [10, 21, -31, 400, 50, 60],
        "position": [15, 26, -26, 405, 55, 65],
        "status": "til",
    }
    assert header["message"]["contact"]["hull"] == [[10.0, 20.1], [30.0, 20.0], [30.0, 40.0]]
    assert header["message"]["contact"]["area"] == 200.123456
    assert hull[0, 0] == 10.04


# -- who is let in ------------------------------------------------------------------------------------------


def get(sink: View, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    assert sink.description is not None
    connection = http.client.HTTPConnection(
        sink.description.removeprefix("http://").rstrip("/"), timeout=PATIENCE
    )
    try:
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        response.body = response.read()  # type: ignore[attr-defined]
        return response
    finally:
        connection.close()


def test_the_page_loads_nothing_from_elsewhere(view: Callable[..., View]) -> None:
    sink = view()
    response = get(sink)
    assert response.status == 200
    policy = response.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
    assert response.headers["x-content-type-options"] == "nosniff"
    names = ["style.css", "app.js", "connection.js", "picture.js", "plot.js", "icon.svg"]
    for name in names:
        file = get(sink, f"/{name}")
        assert file.status == 200, name
        text = file.body.decode()  # type: ignore[attr-defined]
        assert "http" not in text.replace("http://www.w3.org/2000/svg", "").replace('"https:"', ""), name


def test_nothing_but_the_page_is_served(view: Callable[..., View]) -> None:
    sink = view()
    for path in (
        "/../view.py",
        "/%2e%2e/hub.py",
        "/page/app.js",
        "//etc/passwd",
        "/hub.py",
        "/live",
        "/app.js/",
    ):
        assert get(sink, path).status == 404, path


def test_a_foreign_host_name_is_refused(view: Callable[..., View]) -> None:
    sink = view()
    for host in ("evil.example", "evil.example:8765", "", "127.0.0.1.evil.example", "192.168.1.7"):
        assert get(sink, Host=host).status == 421, host


def test_names_of_this_machine_are_served_on_any_port(view: Callable[..., View]) -> None:
    sink = view()
    for host in ("localhost", "localhost:9000", "127.0.0.1:1", "[::1]:8765", "LOCALHOST"):
        assert get(sink, Host=host).status == 200, host


def test_a_websocket_of_another_page_is_refused(view: Callable[..., View], page: Callable[..., Page]) -> None:
    sink = view()
    foreign = ("http://evil.example", "http://127.0.0.1:1", "null", "file://", "http://localhost", None)
    for origin in foreign:
        with pytest.raises(InvalidStatus) as refusal:
            page(sink, origin=origin)
        assert refusal.value.response.status_code == 403, origin
    assert not sink.wants()


def test_a_websocket_under_a_foreign_name_is_refused(view: Callable[..., View]) -> None:
    sink = view()
    assert sink.description is not None
    port = int(sink.description.rstrip("/").rpartition(":")[2])
    foreign = f"evil.example:{port}"
    with (
        socket.create_connection(("127.0.0.1", port)) as wire,
        pytest.raises(InvalidStatus) as refusal,
        connect(f"ws://{foreign}/live", sock=wire, origin=Origin(f"http://{foreign}")),
    ):
        pass
    assert refusal.value.response.status_code == 403


def test_a_page_that_is_gone_has_no_address(view: Callable[..., View]) -> None:
    sink = view()
    assert str(sink.description).startswith("http://127.0.0.1:")
    sink.close()
    assert sink.description is None


def test_a_request_whose_body_is_none_is_refused_without_a_traceback(
    view: Callable[..., View], caplog: pytest.LogCaptureFixture
) -> None:
    where = urlsplit(str(view().description))
    with socket.create_connection((str(where.hostname), where.port or 0), PATIENCE) as connection:
        connection.sendall(
            b"HEAD / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello, you\r\n"
        )
        while connection.recv(65536):
            pass
    assert "Traceback" not in caplog.text


def test_another_address_needs_a_token() -> None:
    with pytest.raises(ValidationError, match="a token is required"):
        View.Params(host="0.0.0.0")
    with pytest.raises(ValidationError, match="at least 16"):
        View.Params(host="0.0.0.0", token="short")
    assert View.Params(host="0.0.0.0", token=SECRET).token == SECRET


def test_a_pipeline_that_serves_the_network_without_a_token_is_not_started(tmp_path: Path) -> None:
    file = tmp_path / "pipeline.yaml"
    file.write_text("stages:\n  capture: {source: 'sim:idle?frames=5'}\nsinks:\n  view:\n    host: 0.0.0.0\n")
    with pytest.raises(ConfigError, match=r"pipeline.yaml:4(.|\n)*token"):
        load_pipeline(file)


def test_a_wrong_token_is_told_so_and_the_right_one_let_in(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view(token=SECRET)
    for path in ("live", "live?token=", f"live?token={SECRET}x", f"live?token={SECRET[:-1]}"):
        assert page(sink, path=path).close_code() == 4401
    assert page(sink, path=f"live?token={SECRET}").next("hello")


def test_on_all_interfaces_any_name_is_ours_but_the_token_is_needed(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view(host="0.0.0.0", token=SECRET)
    assert sink.description is not None
    port = sink.description.rstrip("/").rpartition(":")[2]
    sink.description = f"http://127.0.0.1:{port}/"
    assert get(sink, Host="lab-pc.local:8765").status == 200
    assert get(sink, Host="lab-pc.local:8765 https://evil.example").status == 421
    assert page(sink).close_code() == 4401
    assert page(sink, path=f"live?token={SECRET}").next("hello")


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.1.2", False),
        ("localhost.example", False),
        ("lab-pc", False),
    ],
)
def test_only_loopback_is_loopback(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_addresses_are_written_as_a_browser_takes_them() -> None:
    assert address("127.0.0.1", 8780) == "http://127.0.0.1:8780/"
    assert address("::1", 80) == "http://[::1]:80/"
    assert address("0.0.0.0", 80) == f"http://{socket.gethostname()}:80/"


# -- starting and ending ------------------------------------------------------------------------------------


def test_a_taken_port_gives_way_to_the_next_free_one(
    view: Callable[..., View], caplog: pytest.LogCaptureFixture
) -> None:
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        sink = view(port=port)
        assert sink.description not in (None, f"http://127.0.0.1:{port}/")
        assert f"port {port} is taken" in caplog.text
        assert get(sink).status == 200


def test_a_port_just_left_is_taken_again(view: Callable[..., View], page: Callable[..., Page]) -> None:
    first = view()
    page(first).next("hello")
    left = first.description
    assert left is not None
    first.close()
    port = int(left.rstrip("/").rpartition(":")[2])
    assert view(port=port).description == left


def test_the_address_is_logged(view: Callable[..., View], caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "tactflow"):
        sink = view(token=SECRET)
    assert caplog.messages == [f"view: {sink.description}?token={SECRET}"]


def test_the_browser_is_opened_only_on_request(
    monkeypatch: pytest.MonkeyPatch, view: Callable[..., View]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("tactflow.sinks.view.webbrowser.open", opened.append)
    view()
    asked = view(open_browser=True)
    until(lambda: opened)
    assert opened == [asked.description]


@pytest.mark.parametrize(
    "params",
    [
        {"host": "192.0.2.1", "token": SECRET},
        {"host": "no-such-host.invalid", "token": SECRET},
        {"host": "a..b" * 90, "token": SECRET},
    ],
)
def test_an_address_that_is_not_ours_disables_the_view_only(
    params: dict[str, Any], view: Callable[..., View], caplog: pytest.LogCaptureFixture
) -> None:
    sink = view(**params)
    assert "not shown" in caplog.text
    assert not sink.wants()
    assert sink.description is None


def test_a_package_that_cannot_be_imported_disables_the_view_only(
    monkeypatch: pytest.MonkeyPatch, view: Callable[..., View], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "tactflow.view.server", None)
    sink = view()
    assert sink.description is not None
    socket.create_connection(("127.0.0.1", urlsplit(sink.description).port or 0)).close()
    until(lambda: "not shown" in caplog.text)
    assert not sink.wants()


def test_what_serves_the_page_is_loaded_when_somebody_comes(
    view: Callable[..., View], page: Callable[..., Page]
) -> None:
    sink = view()
    assert "tactflow-view-server" not in {thread.name for thread in threading.enumerate()}
    page(sink).next("hello")
    assert "tactflow-view-server" in {thread.name for thread in threading.enumerate()}


def test_at_the_end_pages_learn_how_it_ended(view: Callable[..., View], page: Callable[..., Page]) -> None:
    sink = view()
    browser = page(sink)
    browser.next("hello")
    sink.close()
    assert browser.until("state", lambda state: state["end"] is not None)["end"] == "eos"
    assert browser.close_code() == 1001


def test_an_opened_view_closes_without_ever_having_had_a_page(view: Callable[..., View]) -> None:
    sink = view()
    sink.close()
    sink.close()
    assert not any(thread.name == "tactflow-view-server" for thread in threading.enumerate())


def test_views_of_several_sensors_know_of_each_other(
    stack: ExitStack, page: Callable[..., Page], tmp_path: Path
) -> None:
    views = {}
    for sensor in ("left", "right"):
        views[sensor] = View(View.Params(port=0, neighbours=str(tmp_path)), sensor, control=FakeRun())
        stack.callback(views[sensor].close)
        views[sensor].open()
    address = views["right"].description
    assert address is not None
    browser = page(views["left"])
    assert browser.next("state")["neighbours"] == {"right": int(address.rstrip("/").rpartition(":")[2])}
    views["right"].close()
    browser.until("state", lambda state: state["neighbours"] == {})


def test_too_many_pages_are_turned_away(view: Callable[..., View], page: Callable[..., Page]) -> None:
    sink = view()
    for _ in range(16):
        page(sink).next("hello")
    assert page(sink).close_code() == 4429


# -- in a run -----------------------------------------------------------------------------------------------


PIPELINE = """
sensor: main
stages:
  capture: {source: "sim:press?frames=100000"}
  preprocess: {downsample: 2}
  difference: {in: {unmarked: preprocess.image}}
  hull: {when: touching}
sinks:
  view: {port: 0, max_fps: 240}
"""


def test_a_page_pauses_steps_and_ends_a_run(
    tmp_path: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "pipeline.yaml"
    file.write_text(PIPELINE)
    runner = Runner(load_pipeline(file))
    held, may_go_on = threading.Event(), runner._may_go_on

    def hold() -> bool:
        held.set()
        return may_go_on()

    monkeypatch.setattr(runner, "_may_go_on", hold)
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(runner.run()))
    thread.start()
    stack.callback(thread.join)
    stack.callback(runner.stop)
    until(lambda: "view" in runner.nodes and runner.nodes["view"].instance.description)
    browser = Page(runner.nodes["view"].instance.description, stack)
    header, _ = browser.next("frame")
    browser.say(do="pause", value=True)
    browser.until("state", lambda state: state["paused"])
    browser.say(ack=header["number"])

    def settle() -> int:
        """The number of frames that were let through once the next one is held."""
        assert held.wait(PATIENCE)
        held.clear()
        return runner.progress().frames

    still = settle()
    browser.say(do="step")
    seen = -1
    while seen < still:
        header, _ = browser.next("frame")
        seen = header["message"]["seq"]
        browser.say(ack=header["number"])
    assert seen == still
    assert settle() == still + 1
    browser.say(do="reference")
    # One frame was captured before the button was pressed, and waits for its step.
    browser.say(do="step")
    header, _ = browser.next("frame")
    assert header["epoch"] == 0
    browser.say(ack=header["number"])
    browser.say(do="step")
    assert browser.next("frame")[0]["epoch"] == 1
    browser.say(do="stop")
    thread.join(PATIENCE)
    assert not thread.is_alive()
    assert results[0].exit_code == 0
    assert results[0].stats["end"] == "signal"
    assert results[0].stats["sinks"]["view"]["counters"]["encoded"] >= 3


def test_a_run_that_nobody_watches_encodes_nothing_and_computes_nothing_for_the_view(tmp_path: Path) -> None:
    file = tmp_path / "pipeline.yaml"
    file.write_text(PIPELINE.replace("100000", "30"))
    result = Runner(load_pipeline(file)).run()
    assert result.exit_code == 0
    assert result.stats["sinks"]["view"]["counters"]["encoded"] == 0
    assert result.stats["sinks"]["view"]["runs"] == 0
    assert result.stats["stages"]["hull"]["runs"] == 0
