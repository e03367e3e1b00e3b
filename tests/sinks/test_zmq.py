"""The ZeroMQ sink: who listens decides, and nobody slows it."""

from __future__ import annotations

import json
import socket as system_socket
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import zmq

import tactflow
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame
from tactflow.engine.plan import make_plan
from tactflow.message.result import Result
from tactflow.sinks.zmq import Zmq
from tactflow.vision.types import Depth, Markers
from tests.clock import PATIENCE, until

IMAGE = np.zeros((300, 400, 3), np.uint8)
MANY = Markers(np.zeros((140, 2)), np.full((140, 2), 1 / 3), np.zeros(140, np.uint8), np.zeros(140))
WAIT = round(PATIENCE * 1000)
"""How long a test waits for what must happen, ms."""

Open = Callable[..., Zmq]
Subscribe = Callable[..., "zmq.Socket[bytes]"]


@pytest.fixture
def opened(stack: ExitStack) -> Open:
    """Makes sinks that are bound."""

    def make(sensor: str = "main", control: Any = None, **params: Any) -> Zmq:
        values = {"endpoint": "tcp://127.0.0.1:*", "linger": 0.1} | params
        sink = Zmq(Zmq.Params(**values), sensor, control)
        stack.callback(sink.close)
        sink.open()
        return sink

    return make


@pytest.fixture
def subscribe(stack: ExitStack) -> Subscribe:
    """Makes plain ZeroMQ subscribers, as the README shows it; returns once the sink knows of them."""
    context = stack.enter_context(zmq.Context())

    def make(sink: Zmq | str, prefix: bytes = b"tactflow.main", **options: int) -> zmq.Socket[bytes]:
        socket = stack.enter_context(context.socket(zmq.SUB))
        socket.linger = 0
        for name, value in options.items():
            socket.setsockopt(getattr(zmq, name), value)
        socket.subscribe(prefix)
        if isinstance(sink, str):
            socket.connect(sink)
            return socket
        before = sink.counters()["subscriptions"]
        socket.connect(sink.endpoint)
        until(lambda: sink.wants() is None or sink.counters()["subscriptions"] > before)
        return socket

    return make


def write(sink: Zmq, seqs: range, **values: Any) -> None:
    for seq in seqs:
        sink.write(Result(Frame("main", seq, seq / 10.0, IMAGE), {"markers": MANY} | values))


def receive(socket: zmq.Socket[bytes]) -> tuple[bytes, dict[str, Any]]:
    assert socket.poll(WAIT)
    topic, _, body = socket.recv().partition(b" ")
    return topic, json.loads(body)


def test_a_subscriber_gets_topic_and_json_in_one_frame(opened: Open, subscribe: Subscribe) -> None:
    sink = opened("thumb")
    socket = subscribe(sink, b"tactflow.thumb")
    write(sink, range(3))
    for seq in range(3):
        topic, message = receive(socket)
        assert not socket.getsockopt(zmq.RCVMORE)
        assert topic == b"tactflow.thumb"
        assert message["seq"] == seq
        assert len(message["markers"]["status"]) == 140


@pytest.mark.parametrize(
    ("prefix", "wanted"),
    [
        (b"", True),
        (b"tactflow.mai", True),
        (b"tactflow.main ", True),
        (b'tactflow.main {"schema"', True),
        (b"tactflow.main2", False),
        (b"tactflow.thumb", False),
        (b"something else", False),
    ],
)
def test_only_a_subscription_to_this_sensor_counts(
    prefix: bytes, wanted: bool, opened: Open, subscribe: Subscribe
) -> None:
    sink = opened()
    assert not sink.wants()
    write(sink, range(9))
    assert sink.counters() == {"serialised": 0, "subscriptions": 0}
    socket = subscribe(sink, prefix)
    assert sink.wants() == wanted
    write(sink, range(2))
    assert sink.counters()["serialised"] == (2 if wanted else 0)
    socket.close()
    until(lambda: not sink.wants() and sink.counters()["subscriptions"] == 0)


def test_a_conflating_subscriber_that_pauses_gets_the_newest(opened: Open, subscribe: Subscribe) -> None:
    sink = opened()
    socket = subscribe(sink, CONFLATE=1)
    probe = subscribe(sink, b"tactflow.")
    for seq in range(40):
        write(sink, range(seq, seq + 1))
        receive(probe)
    # What is under way to `socket` arrives within moments; the newest one replaces all before it.
    newest = -1
    while newest < 39:
        newest = receive(socket)[1]["seq"]
    assert not socket.poll(50)


def test_closing_delivers_the_last_messages_and_may_come_twice(opened: Open, subscribe: Subscribe) -> None:
    for _ in range(5):
        sink = opened(linger=60)
        socket = subscribe(sink)
        write(sink, range(5))
        sink.close()
        assert [receive(socket)[1]["seq"] for _ in range(5)] == [0, 1, 2, 3, 4]
        sink.close()
        write(sink, range(1))
        assert not sink.wants()


def test_an_address_in_use_is_an_error_that_says_what_to_try(opened: Open) -> None:
    first = opened()
    with pytest.raises(StageError, match="is in use") as raised:
        opened(endpoint=first.endpoint)
    for words in (first.endpoint, "--set sinks.zmq.endpoint=", "--set sinks.zmq=null"):
        assert words in str(raised.value)
    first.close()
    opened(endpoint=first.endpoint)
    with pytest.raises(StageError, match="cannot be bound"):
        opened(endpoint="tcp://nobody.invalid:5556", open_to_all=True)


def test_an_ipc_address_takes_no_file_and_no_other_runs_place(opened: Open, tmp_path: Path) -> None:
    file, place = tmp_path / "notes.txt", tmp_path / "tactflow"
    file.write_text("precious")
    with pytest.raises(StageError, match=r"notes\.txt is a file"):
        opened(endpoint=f"ipc://{file}")
    assert file.read_text() == "precious"
    first = opened(endpoint=f"ipc://{place}")
    with pytest.raises(StageError, match="is in use"):
        opened(endpoint=f"ipc://{place}")
    first.close()
    # What a killed run leaves behind is in nobody's way.
    with system_socket.socket(system_socket.AF_UNIX) as left:
        place.unlink(missing_ok=True)
        left.bind(str(place))
    opened(endpoint=f"ipc://{place}")


def test_asking_who_listens_is_safe_while_another_thread_sends(opened: Open, subscribe: Subscribe) -> None:
    sink = opened()
    socket = subscribe(sink)
    stop = threading.Event()
    answers: set[bool] = set()

    def ask() -> None:
        while not stop.is_set():
            answers.add(sink.wants())

    thread = threading.Thread(target=ask)
    thread.start()
    for seq in range(300):
        write(sink, range(seq, seq + 1))
        assert receive(socket)[1]["seq"] == seq
    stop.set()
    thread.join()
    assert answers == {True}


class Run:
    """Stands for a run; counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0
        self.ready = threading.Event()

    def snapshot(self) -> dict[str, Any]:
        self.asked += 1
        self.ready.set()
        return {"frames": np.int64(self.asked), "stages": {}}


def test_statistics_come_without_any_frame_to_whoever_asks_for_them_by_name(
    opened: Open, subscribe: Subscribe
) -> None:
    run = Run()
    sink = opened("left", control=cast(Any, run), stats_every=0.01)
    frames = subscribe(sink, b"tactflow.")
    # Ten times the interval: the thread has looked at the subscriptions several times.
    assert not run.ready.wait(0.1)
    frames.close()
    until(lambda: not sink.wants())
    socket = subscribe(sink, b"tactflow.stats")
    assert not sink.wants()
    topic, first = receive(socket)
    _, second = receive(socket)
    assert topic == b"tactflow.stats"
    assert first["sensor"] == "left"
    assert second["frames"] > first["frames"]
    assert sink.counters()["serialised"] == 0


def test_pictures_and_depth_maps_go_to_who_asks_for_them_by_name(opened: Open, subscribe: Subscribe) -> None:
    sink = opened(pictures=100)
    picture = subscribe(sink, b"tactflow_picture.main")
    heights = np.arange(12, dtype=np.float32).reshape(3, 4)
    small = np.zeros((3, 4, 3), np.uint8)
    depth = Depth(heights, 11.0, None, 1.0, None)
    write(sink, range(1), image=small, depth=depth)
    header, _, data = picture.recv().partition(b"\n")
    assert header.startswith(b'tactflow_picture.main {"sensor":"main","seq":0,"t":0.0,"size":[4,3]}')
    assert data[:2] == b"\xff\xd8"
    assert not picture.poll(0)
    maps = subscribe(sink, b"tactflow_depth.main")
    write(sink, range(1, 2), image=small, depth=depth)
    write(sink, range(2, 3), image=small)
    for expected in (heights, np.zeros((3, 4))):
        data = maps.recv().partition(b"\n")[2]
        assert np.array_equal(np.frombuffer(data, "<f4").reshape(3, 4), expected)


def test_pictures_have_their_rate_and_are_off_unless_asked_for(opened: Open, subscribe: Subscribe) -> None:
    sink = opened(pictures=5)
    picture = subscribe(sink, b"tactflow_picture.main")
    write(sink, range(10))
    seqs = [json.loads(picture.recv().split(b" ", 1)[1].split(b"\n")[0])["seq"] for _ in range(5)]
    assert seqs == [0, 2, 4, 6, 8]
    assert not picture.poll(0)
    silent = opened()
    subscribe(silent, b"tactflow_picture.main")
    assert not silent.wants()


def test_it_runs_where_the_results_are_and_drops_old_ones_in_a_thread_of_its_own() -> None:
    sinks: dict[str, Any] = {"zmq": {"endpoint": "tcp://127.0.0.1:*"}}
    for own, expected in ((None, []), ("publishing", ["latest"])):
        pipeline = tactflow.load(settings={"sinks": sinks | {"zmq": sinks["zmq"] | {"segment": own}}})
        links = make_plan(pipeline, live=True).links
        assert [link.when_full for link in links if link.producer == "compute"] == expected
