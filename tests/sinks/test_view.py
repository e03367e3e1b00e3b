"""The view as its pages see it: real sockets, no browser."""

from __future__ import annotations

import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import Mock, call
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tactflow.engine.contract import Recorder, Source, StageParams
from tactflow.engine.control import Control
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.sinks.view import View
from tactflow.view import server
from tactflow.view.address import bind
from tactflow.vision.flow import FieldModel
from tactflow.vision.types import Contact, Depth, Markers, Scale
from tests.clock import PATIENCE, until

SECRET = "a-secret-of-some-length"
Views = Callable[..., View]
Pages = Callable[..., "Page"]


class FakeSource(Source):
    """A source that is as the test wants it."""

    total = 600
    description = "a test"
    words = "running"

    @property
    def state(self) -> str:
        return self.words

    def retake(self) -> None: ...


def fake_run(*, live: bool = False, recorder: Any = None) -> Any:
    """A run that notes what it is asked to do, in `mock_calls`."""
    run = Mock(Control, paused=False, source=FakeSource(StageParams()))
    run.source.live = live
    run.recorder.return_value = recorder
    run.snapshot.return_value = {"frames": 3, "end": "eos", "stages": {}, "sinks": {}, "links": {}}
    run.pause.side_effect = lambda paused: setattr(run, "paused", paused)
    return run


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
            View.Params(**{"port": 0, "max_fps": 240.0} | params), "main", control=control or fake_run()
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


def result(seq: int, **values: Any) -> Result:
    frame = Frame("main", seq, seq / 60, picture(), time.perf_counter())
    return Result(frame, values, {"contact": "no_contact"})


def write(sink: View, seq: int) -> None:
    """Have a frame shown, as the engine does: when the sink wants one."""
    until(sink.wants)
    sink.write(result(seq, image=picture()))


def test_without_a_page_nothing_is_wanted_and_nothing_encoded(view: Views) -> None:
    sink = view()
    assert not sink.wants()
    sink.write(result(0, image=picture()))
    assert sink.counters()["encoded"] == 0
    sink.close()
    sink.close()


def test_a_page_gets_the_plain_picture_and_the_result_message(view: Views, page: Pages) -> None:
    sink = view(quality=95)
    browser = page(sink)
    assert browser.next("hello")["sensors"] == ["main"]
    write(sink, 7)
    header, jpeg = browser.next("frame")
    sent = result(7, image=picture())
    assert header["message"] == sent.to_dict(detail=True)
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    # Measured: a mean of 1.0 grey level at quality 95; a picture that was drawn on, or another one, has tens.
    assert np.abs(shown.astype(int) - picture()).mean() < 3
    assert header["latency_ms"] >= 0


def test_a_page_is_sent_nothing_more_until_it_has_drawn(view: Views, page: Pages) -> None:
    sink = view()
    browser = page(sink)
    write(sink, 0)
    first, _ = browser.next("frame")
    until(lambda: not sink.wants())
    sink.write(result(1, image=picture()))
    assert sink.counters()["encoded"] == 1
    browser.say(ack=first["number"])
    write(sink, 2)
    assert browser.next("frame")[0]["message"]["seq"] == 2


def test_a_slow_page_gets_the_newest_frame_and_holds_up_nobody(view: Views, page: Pages) -> None:
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


def test_a_page_that_reads_nothing_holds_up_neither_writing_nor_closing(view: Views, page: Pages) -> None:
    sink = view()
    # It says that it drew, but its receive buffer is full and stays so.
    deaf = page(sink, max_queue=1, close_timeout=0.1)
    fast = page(sink)
    until(lambda: sink.counters()["pages"] == 2)
    noise = np.random.default_rng(1).integers(0, 256, (800, 800, 3)).astype(np.uint8)
    for number in range(1, 60):
        until(sink.wants)
        sink.write(result(number, image=noise))
        fast.say(ack=fast.next("frame")[0]["number"])
        deaf.say(ack=number)
    assert fast.next("stats")["run"]["frames"] == 3
    sink.close()
    assert not any(thread.name == "tactflow-view-server" for thread in threading.enumerate())


def test_max_fps_bounds_what_is_encoded(view: Views, page: Pages) -> None:
    sink = view(max_fps=1e-6)
    browser = page(sink)
    write(sink, 0)
    browser.say(ack=browser.next("frame")[0]["number"])
    until(lambda: sink._hub is not None and sink._hub.wanted)
    # The page is ready, but the next frame is due in six days.
    assert not sink.wants()
    sink.write(result(1, image=picture()))
    assert sink.counters()["encoded"] == 1


def test_a_large_picture_is_reduced_and_its_coordinates_are_not(view: Views, page: Pages) -> None:
    sink = view(max_size=64)
    browser = page(sink)
    until(sink.wants)
    sink.write(result(0, image=picture(100, 200)))
    header, jpeg = browser.next("frame")
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (64, 32, 3)
    assert header["message"]["size"] == [100, 200]


def test_a_page_that_comes_late_to_a_paused_run_sees_the_last_picture(view: Views, page: Pages) -> None:
    run = fake_run()
    sink = view(run)
    first = page(sink)
    write(sink, 5)
    first.next("frame")
    run.pause(True)
    assert page(sink).next("frame")[0]["message"]["seq"] == 5


def test_field_and_heights_are_sent_with_the_picture(view: Views, page: Pages) -> None:
    origin = np.array([[10.0, 10], [50, 10], [10, 70], [50, 70]])
    markers = Markers(origin, origin + np.array([2, 0]), np.zeros(4, np.uint8), np.full(4, 0.02))
    heights = np.zeros((80, 60), np.float32)
    heights[20:40, 10:50] = np.linspace(0.1, 0.5, 40)
    found = {
        "scale": Scale(0.1, 0.2, (0, 0), (30, 40)),
        "depth": Depth(heights, 0.5, None, 1.0, None),
        "field": FieldModel(origin, (60, 80))(markers),
    }
    sink = view()
    browser = page(sink)
    until(sink.wants)
    sink.write(result(1, image=picture(), **found))
    header, data = browser.next("frame")
    assert header["scale"] == [0.1, 0.2]
    said = header["surface"]
    assert said["box"] == [10, 20, 40, 20]
    assert data[said["bytes"] :][:2] == b"\xff\xd8"
    cells = np.frombuffer(data[: said["bytes"]], "<u2").reshape(said["size"][::-1]) * said["step"]
    middle = heights[20:40, 10:50].reshape(10, 2, 20, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(cells, middle, atol=said["step"])
    assert np.ptp(np.subtract(header["field"]["position"], header["field"]["origin"])[::2]) <= 10


@pytest.mark.parametrize("state", ["running", "waiting since 12:00:00 (no frames)"])
def test_a_source_that_is_held_is_not_said_to_run(state: str, view: Views, page: Pages) -> None:
    run = fake_run()
    run.source.words = state
    browser = page(view(run))
    assert browser.next("state")["source"]["state"] == state
    browser.say(do="pause", value=True)
    held = browser.until("state", lambda told: told["paused"])["source"]["state"]
    assert held == ("paused" if state == "running" else state), "a fault is told even then"
    browser.say(do="pause", value=False)
    assert browser.until("state", lambda told: not told["paused"])["source"]["state"] == state


def test_buttons_reach_the_run_and_every_page_learns_of_it(view: Views, page: Pages) -> None:
    run = fake_run()
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
    expected = [call.pause(True), call.step(), call.retake_reference(), call.pause(False), call.stop()]
    until(lambda: all(wanted in run.mock_calls for wanted in expected))
    assert [done for done in run.mock_calls if done in expected] == expected


@pytest.mark.parametrize(
    ("live", "message", "words"),
    [
        (False, {"do": "step"}, "pause first"),
        (True, {"do": "step"}, "live source"),
        (False, {"do": ["pause"]}, "no command"),
    ],
)
def test_what_is_not_possible_is_refused_with_a_reason(
    live: bool, message: dict[str, Any], words: str, view: Views, page: Pages
) -> None:
    run = fake_run(live=live)
    browser = page(view(run))
    browser.say(**message)
    assert words in browser.next("note")["text"]
    assert not [done for done in run.mock_calls if done in (call.pause(True), call.step(), call.stop())]


def test_a_record_sink_is_started_and_stopped_and_its_failure_ends_nothing(
    view: Views, page: Pages, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = Mock(Recorder, recording=False)
    recorder.start_recording.side_effect = lambda: setattr(recorder, "recording", True)
    recorder.stop_recording.side_effect = OSError("no space left")
    browser = page(view(fake_run(recorder=recorder)))
    assert browser.next("state")["refused"]["record"] is None
    browser.say(do="record", value=True)
    browser.until("state", lambda state: state["recording"])
    assert recorder.recording
    browser.say(do="record", value=False)
    assert "no space left" in browser.next("note")["text"]
    assert "no space left" in caplog.text
    browser.next("stats")


def test_junk_ends_that_page_and_no_other(view: Views, page: Pages) -> None:
    sink = view()
    good = page(sink)
    for junk in ("", "not json", "[]", "7", '"' + "x" * 8000 + '"'):
        bad = page(sink)
        bad.socket.send(junk)
        assert bad.close_code() in (1008, 1009), junk
    write(sink, 0)
    assert good.next("frame")[0]["message"]["seq"] == 0


def test_what_is_only_drawn_is_sent_in_tenths_of_a_pixel(view: Views, page: Pages) -> None:
    sink = view()
    browser = page(sink)
    hull = np.array([[10.04, 20.06], [30.0, 20.0], [30.0, 40.0]])
    contact = Contact(200.123456, (23.3, 26.7), None, None, hull, None)
    origin = np.array([[1.04, 2.06], [-3.14159, 40.0], [5.0, 6.0]])
    markers = Markers(origin, origin + 0.5, np.array([0, 1, 2], np.uint8), np.full(3, np.nan))
    until(sink.wants)
    sink.write(result(0, image=picture(), contact=contact, markers=markers))
    header, _ = browser.next("frame")
    assert header["markers"] == {
        "origin": [10, 21, -31, 400, 50, 60],
        "position": [15, 26, -26, 405, 55, 65],
        "status": "til",
    }
    assert header["message"]["contact"]["hull"] == [[10.0, 20.1], [30.0, 20.0], [30.0, 40.0]]
    assert header["message"]["contact"]["area"] == 200.123456
    assert hull[0, 0] == 10.04


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


def test_the_page_loads_nothing_from_elsewhere(view: Views) -> None:
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


def test_nothing_but_the_page_is_served(view: Views) -> None:
    sink = view()
    for path in ("/../view.py", "/%2e%2e/hub.py", "/page/app.js", "//etc/passwd", "/hub.py", "/live", "//["):
        assert get(sink, path).status == 404, path


def test_only_names_of_this_machine_are_served(view: Views) -> None:
    sink = view()
    for host in ("evil.example", "evil.example:8765", "", "127.0.0.1.evil.example", "192.168.1.7"):
        assert get(sink, Host=host).status == 421, host
    for host in ("localhost", "localhost:9000", "127.0.0.1:1", "[::1]:8765", "LOCALHOST"):
        assert get(sink, Host=host).status == 200, host


def test_a_websocket_of_another_page_or_under_a_foreign_name_is_refused(view: Views, page: Pages) -> None:
    sink = view()
    where = urlsplit(str(sink.description))
    for origin in ("http://evil.example", "http://127.0.0.1:1", "null", "file://", "http://localhost", None):
        with pytest.raises(InvalidStatus) as refusal:
            page(sink, origin=origin)
        assert refusal.value.response.status_code == 403, origin
    foreign = f"evil.example:{where.port}"
    with (
        socket.create_connection((str(where.hostname), where.port or 0)) as wire,
        pytest.raises(InvalidStatus) as refusal,
        connect(f"ws://{foreign}/live", sock=wire, origin=Origin(f"http://{foreign}")),
    ):
        pass
    assert refusal.value.response.status_code == 403
    assert not sink.wants()


def test_another_address_needs_a_token() -> None:
    with pytest.raises(ValidationError, match="a token is required"):
        View.Params(host="0.0.0.0")
    with pytest.raises(ValidationError, match="at least 16"):
        View.Params(host="0.0.0.0", token="short")
    assert View.Params(host="0.0.0.0", token=SECRET).token == SECRET


def test_a_wrong_token_is_told_so_and_the_right_one_let_in(view: Views, page: Pages) -> None:
    sink = view(token=SECRET)
    for path in ("live", "live?token=", f"live?token={SECRET}x", f"live?token={SECRET[:-1]}"):
        assert page(sink, path=path).close_code() == 4401
    assert page(sink, path=f"live?token={SECRET}").next("hello")
    # On all interfaces, any name is ours.
    everywhere = view(host="0.0.0.0", token=SECRET)
    everywhere.description = f"http://127.0.0.1:{urlsplit(str(everywhere.description)).port}/"
    assert get(everywhere, Host="lab-pc.local:8765").status == 200
    assert get(everywhere, Host="lab-pc.local:8765 https://evil.example").status == 421
    assert page(everywhere).close_code() == 4401
    assert page(everywhere, path=f"live?token={SECRET}").next("hello")


def test_a_taken_port_gives_way_to_the_next_free_one(view: Views, caplog: pytest.LogCaptureFixture) -> None:
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        sink = view(port=port)
        assert sink.description not in (None, f"http://127.0.0.1:{port}/")
        assert f"port {port} is taken" in caplog.text
        assert get(sink).status == 200


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid", "a..b" * 90])
def test_an_address_that_is_not_ours_disables_the_view_only(
    host: str, view: Views, caplog: pytest.LogCaptureFixture
) -> None:
    sink = view(host=host, token=SECRET)
    assert "not shown" in caplog.text
    assert not sink.wants()
    assert sink.description is None


def test_at_the_end_pages_learn_how_it_ended(view: Views, page: Pages) -> None:
    sink = view()
    browser = page(sink)
    browser.next("hello")
    sink.close()
    assert browser.until("state", lambda state: state["end"] is not None)["end"] == "eos"
    assert browser.close_code() == 1001
    assert sink.description is None
