"""The ZeroMQ sink: who listens decides, and nobody slows it."""

from __future__ import annotations

import json
import socket as system_socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import zmq
from pydantic import ValidationError

from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame, Tick
from tactflow.network.publisher import SEND_BUFFER
from tactflow.sinks.zmq import MOST_OTHERS, Zmq
from tactflow.vision.types import Depth, Markers
from tests.clock import PATIENCE, until
from tests.messages import Results, result_of

IMAGE = np.zeros((300, 400, 3), np.uint8)
MANY = Markers(np.zeros((140, 2)), np.full((140, 2), 1 / 3), np.zeros(140, np.uint8), np.zeros(140))
WAIT = round(PATIENCE * 1000)
"""How long a test waits for what must happen, ms."""


def tick(seq: int, sensor: str = "main") -> Tick:
    return Tick(Frame(sensor, seq, seq / 10.0, IMAGE))


def opened(**params: Any) -> Zmq:
    sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*", **params))
    sink.open()
    return sink


def write(sink: Zmq, seqs: range) -> None:
    for seq in seqs:
        sink.write(result_of(tick(seq), Results(IMAGE, None, None, MANY)))


def wait_until_wanted(sink: Zmq) -> None:
    """Return when a subscription has arrived: an event on the publisher's socket, not a sleep."""
    sink._wait_for_subscriber(WAIT / 1000)
    assert sink.wants()


class Subscribing:
    """A plain ZeroMQ subscriber, as the README shows it."""

    def __init__(self) -> None:
        self.context = zmq.Context()
        self.sockets: list[Any] = []

    def __call__(self, endpoint: str, prefix: bytes = b"tactflow.main", **options: int) -> Any:
        socket = self.context.socket(zmq.SUB)
        socket.linger = 0
        for name, value in options.items():
            socket.setsockopt(getattr(zmq, name), value)
        socket.subscribe(prefix)
        socket.connect(endpoint)
        self.sockets.append(socket)
        return socket

    def close(self) -> None:
        for socket in self.sockets:
            socket.close()
        self.context.term()


@pytest.fixture
def subscribe() -> Iterator[Subscribing]:
    subscribing = Subscribing()
    yield subscribing
    subscribing.close()


def receive(socket: Any) -> tuple[bytes, dict[str, Any]]:
    assert socket.poll(WAIT)
    assert not socket.getsockopt(zmq.RCVMORE)
    topic, _, body = socket.recv().partition(b" ")
    return topic, json.loads(body)


def test_a_subscriber_gets_topic_and_json_in_one_frame(subscribe: Subscribing) -> None:
    sink = opened()
    socket = subscribe(sink.endpoint)
    wait_until_wanted(sink)
    write(sink, range(3))
    for seq in range(3):
        topic, message = receive(socket)
        assert not socket.getsockopt(zmq.RCVMORE)
        assert topic == b"tactflow.main"
        assert message["seq"] == seq
        assert len(message["markers"]["status"]) == 140
    sink.close()


def test_nothing_is_wanted_or_encoded_while_nobody_listens() -> None:
    sink = opened()
    assert not sink.wants()
    write(sink, range(100))
    assert sink.counters() == {"serialised": 0, "subscriptions": 0}
    sink.close()


@pytest.mark.parametrize(
    ("prefix", "wanted"),
    [
        (b"", True),
        (b"tactflow.", True),
        (b"tactflow.main", True),
        (b"tactflow.main ", True),
        (b'tactflow.main {"schema"', True),
        (b"tactflow.mai", True),
        (b"tactflow.main2", False),
        (b"tactflow.thumb", False),
        (b"something else", False),
    ],
)
def test_only_a_subscription_to_this_sensor_counts(
    prefix: bytes, wanted: bool, subscribe: Subscribing
) -> None:
    sink = opened()
    subscribe(sink.endpoint, prefix)
    assert sink._socket is not None
    assert sink._socket.poll(WAIT), "the subscription did not arrive"
    assert sink.wants() == wanted
    write(sink, range(2))
    assert sink.counters() == {"serialised": 2 if wanted else 0, "subscriptions": 1}
    sink.close()


def test_nothing_is_encoded_any_more_after_the_last_subscriber_has_left(subscribe: Subscribing) -> None:
    sink = opened()
    socket = subscribe(sink.endpoint)
    wait_until_wanted(sink)
    write(sink, range(1))
    socket.close()
    assert sink._socket is not None
    assert sink._socket.poll(WAIT), "the end of the subscription did not arrive"
    assert not sink.wants()
    write(sink, range(1, 50))
    assert sink.counters() == {"serialised": 1, "subscriptions": 0}
    sink.close()


def test_a_subscriber_that_never_reads_neither_blocks_the_run_nor_its_end(subscribe: Subscribing) -> None:
    sink = opened(linger=0.1)
    # It accepts little itself, so that everything piles up at the publisher.
    subscribe(sink.endpoint, RCVHWM=1, RCVBUF=4096)
    wait_until_wanted(sink)
    done = threading.Event()

    def run() -> None:
        write(sink, range(2000))
        sink.close()
        done.set()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert done.wait(PATIENCE)
    assert sink.counters()["serialised"] == 2000


def test_a_subscriber_that_reads_is_not_held_up_by_one_that_does_not(subscribe: Subscribing) -> None:
    sink = opened(linger=0.1)
    subscribe(sink.endpoint, RCVHWM=1, RCVBUF=4096)
    wait_until_wanted(sink)
    reader = subscribe(sink.endpoint, b"tactflow.")
    assert sink._socket is not None
    assert sink._socket.poll(WAIT)
    assert sink.wants()
    for seq in range(500):
        write(sink, range(seq, seq + 1))
        assert receive(reader)[1]["seq"] == seq
    sink.close()


def test_a_conflating_subscriber_that_pauses_gets_the_newest(subscribe: Subscribing) -> None:
    sink = opened()
    socket = subscribe(sink.endpoint, CONFLATE=1)
    probe = subscribe(sink.endpoint, b"tactflow.")
    assert sink._socket is not None
    while sink.counters()["subscriptions"] < 2:
        assert sink._socket.poll(WAIT)
        sink.wants()
    for seq in range(40):
        write(sink, range(seq, seq + 1))
        receive(probe)
    # What is under way to `socket` arrives within moments; the newest one replaces all before it.
    newest = -1
    while newest < 39:
        newest = receive(socket)[1]["seq"]
    assert not socket.poll(50)
    sink.close()


def test_closing_delivers_the_last_messages(subscribe: Subscribing) -> None:
    for _ in range(5):
        sink = opened(linger=60)
        socket = subscribe(sink.endpoint)
        wait_until_wanted(sink)
        write(sink, range(5))
        sink.close()
        assert [receive(socket)[1]["seq"] for _ in range(5)] == [0, 1, 2, 3, 4]
        socket.close()


def test_an_address_in_use_is_an_error_that_says_what_to_try() -> None:
    first = opened()
    second = Zmq(Zmq.Params(endpoint=first.endpoint))
    with pytest.raises(StageError, match="is in use") as raised:
        second.open()
    for words in (first.endpoint, "--set sinks.zmq.endpoint=", "--set sinks.zmq=null"):
        assert words in str(raised.value)
    second.close()
    first.close()
    again = Zmq(Zmq.Params(endpoint=first.endpoint))
    again.open()
    again.close()


def test_an_address_of_no_machine_is_an_error() -> None:
    sink = Zmq(Zmq.Params(endpoint="tcp://nobody.invalid:5556", open_to_all=True))
    with pytest.raises(StageError, match="cannot be bound"):
        sink.open()
    sink.close()


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("5556", "required an address such as tcp://127"),
        ("tcp://127.0.0.1", "required an address such as tcp://127"),
        ("tcp://127.0.0.1:99999", "required a port up to 65535, got 99999"),
    ],
)
def test_what_is_not_an_address_is_refused(endpoint: str, words: str) -> None:
    for address in ("endpoint", "control"):
        with pytest.raises(ValidationError, match=words):
            Zmq.Params.model_validate({address: endpoint})


@pytest.mark.parametrize("name", ["backlog", "send_buffer"])
def test_numbers_that_zeromq_cannot_take_are_refused(name: str) -> None:
    with pytest.raises(ValidationError, match="less than or equal to 2147483647"):
        Zmq.Params.model_validate({name: 2**31})


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such addresses")
def test_an_ipc_address_takes_no_file_and_no_other_runs_place(tmp_path: Path) -> None:
    file, place = tmp_path / "notes.txt", tmp_path / "tactflow"
    file.write_text("precious")
    with pytest.raises(StageError, match=r"notes\.txt is a file"):
        Zmq(Zmq.Params(endpoint=f"ipc://{file}")).open()
    assert file.read_text() == "precious"
    first, second = (Zmq(Zmq.Params(endpoint=f"ipc://{place}")) for _ in range(2))
    first.open()
    with pytest.raises(StageError, match="is in use"):
        second.open()
    first.close()
    # What a killed run leaves behind is in nobody's way.
    with system_socket.socket(system_socket.AF_UNIX) as left:
        place.unlink(missing_ok=True)
        left.bind(str(place))
    second.open()
    second.close()


def subscribe_by_hand(endpoint: str, topic: bytes) -> None:
    """Send a subscription that no library would, by the wire protocol (ZMTP 3.0), and hang up."""
    host, _, port = endpoint.removeprefix("tcp://").partition(":")
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
    ready = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"
    message = b"\x01" + topic
    with system_socket.create_connection((host, int(port)), timeout=PATIENCE) as connection:
        connection.sendall(greeting + bytes([4, len(ready)]) + ready)
        with suppress(OSError):
            connection.sendall(b"\x02" + len(message).to_bytes(8, "big") + message)
            while connection.recv(4096):
                pass


def test_hostile_subscriptions_are_neither_kept_nor_read_without_bound(subscribe: Subscribing) -> None:
    sink = opened()
    flood = subscribe(sink.endpoint)
    for number in range(3000):
        flood.subscribe(b"nonsense %d" % number)
    # ZeroMQ keeps subscriptions in a tree, and takes a step on the stack for each of its bytes.
    subscribe_by_hand(sink.endpoint, bytes(1 << 20))
    good = subscribe(sink.endpoint)
    wait_until_wanted(sink)

    def heard() -> int:
        write(sink, range(1))
        return good.poll(20)

    until(heard)
    assert receive(good)[1]["seq"] == 0
    assert sink.counters()["subscriptions"] <= MOST_OTHERS + 1
    sink.close()


def test_opening_can_wait_for_a_subscriber(subscribe: Subscribing) -> None:
    reserved = opened()
    endpoint = reserved.endpoint
    reserved.close()
    sink = Zmq(Zmq.Params(endpoint=endpoint, wait_for_subscriber=WAIT / 1000))
    socket = subscribe(endpoint)
    sink.open()
    assert sink.wants()
    write(sink, range(1))
    assert receive(socket)[1]["seq"] == 0
    sink.close()


def test_waiting_for_a_subscriber_ends_without_one() -> None:
    sink = opened(wait_for_subscriber=0.05)
    assert not sink.wants()
    sink.close()


def test_asking_who_listens_is_safe_while_another_thread_sends(subscribe: Subscribing) -> None:
    sink = opened()
    socket = subscribe(sink.endpoint)
    wait_until_wanted(sink)
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
    sink.close()
    assert answers == {True}


def test_the_sensor_names_the_topic(subscribe: Subscribing) -> None:
    sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*"), sensor="thumb")
    sink.open()
    socket = subscribe(sink.endpoint, b"tactflow.thumb")
    wait_until_wanted(sink)
    sink.write(result_of(tick(4, "thumb"), Results(IMAGE, None, None, None)))
    topic, message = receive(socket)
    assert topic == b"tactflow.thumb"
    assert message["sensor"] == "thumb"
    sink.close()


def test_writing_and_asking_after_the_end_is_harmless() -> None:
    sink = opened()
    sink.close()
    sink.close()
    write(sink, range(1))
    assert not sink.wants()


class Run:
    """Stands for a run; counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0
        self.ready = threading.Event()

    def snapshot(self) -> dict[str, Any]:
        self.asked += 1
        self.ready.set()
        return {"frames": self.asked, "stages": {}}


def with_statistics(run: Run) -> Zmq:
    sink = Zmq(
        Zmq.Params(endpoint="tcp://127.0.0.1:*", stats_every=0.01), sensor="left", control=cast(Any, run)
    )
    sink.open()
    return sink


def test_statistics_come_on_their_own_topic_without_any_frame(subscribe: Subscribing) -> None:
    run = Run()
    sink = with_statistics(run)
    socket = subscribe(sink.endpoint, b"tactflow.stats")
    topic, first = receive(socket)
    _, second = receive(socket)
    sink.close()
    assert topic == b"tactflow.stats"
    assert first["sensor"] == "left"
    assert second["frames"] > first["frames"]
    assert sink.counters()["serialised"] == 0


def test_nobody_pays_for_statistics_until_they_are_asked_for_by_name(subscribe: Subscribing) -> None:
    run = Run()
    sink = with_statistics(run)
    frames = subscribe(sink.endpoint, b"tactflow.")
    wait_until_wanted(sink)
    # Ten times the interval: the thread has looked at the subscriptions several times.
    assert not run.ready.wait(0.1)
    write(sink, range(1))
    assert receive(frames)[0] == b"tactflow.left"
    subscribe(sink.endpoint, b"tactflow.stats ")
    assert run.ready.wait(WAIT / 1000)
    sink.close()


def test_a_subscriber_to_statistics_asks_for_no_frames(subscribe: Subscribing) -> None:
    run = Run()
    sink = with_statistics(run)
    receive(subscribe(sink.endpoint, b"tactflow.stats"))
    assert not sink.wants()
    sink.close()


def test_pictures_and_depth_maps_go_to_who_asks_for_them_by_name(subscribe: Subscribing) -> None:
    sink = opened(pictures=100)
    picture = subscribe(sink.endpoint, b"tactflow_picture.main")
    wait_until_wanted(sink)
    heights = np.arange(12, dtype=np.float32).reshape(3, 4)
    small = np.zeros((3, 4, 3), np.uint8)
    depth = Depth(heights, 11.0, None, 1.0, None)
    sink.write(result_of(tick(0), Results(small, depth=depth)))
    header, _, data = picture.recv().partition(b"\n")
    assert header.startswith(b'tactflow_picture.main {"sensor":"main","seq":0,"t":0.0,"size":[4,3]}')
    assert data[:2] == b"\xff\xd8"
    assert not picture.poll(0)

    maps = subscribe(sink.endpoint, b"tactflow_depth.main")
    until(lambda: sink.wants() and "depth" in sink._asked)
    sink.write(result_of(tick(1), Results(small, depth=depth)))
    sink.write(result_of(tick(2), Results(small)))
    for expected in (heights, np.zeros((3, 4))):
        data = maps.recv().partition(b"\n")[2]
        assert np.array_equal(np.frombuffer(data, "<f4").reshape(3, 4), expected)
    sink.close()


def test_pictures_have_their_rate_and_are_off_unless_asked_for(subscribe: Subscribing) -> None:
    sink = opened(pictures=5)
    picture = subscribe(sink.endpoint, b"tactflow_picture.main")
    wait_until_wanted(sink)
    write(sink, range(10))
    seqs = [json.loads(picture.recv().split(b" ", 1)[1].split(b"\n")[0])["seq"] for _ in range(5)]
    assert seqs == [0, 2, 4, 6, 8]
    assert not picture.poll(0)
    sink.close()
    silent = opened()
    subscribe(silent.endpoint, b"tactflow_picture.main")
    until(lambda: silent.wants() or silent.counters()["subscriptions"])
    assert not silent.wants()
    silent.close()


def test_the_send_buffer_holds_a_segment_of_the_loopback_device() -> None:
    # Else messages that are longer, such as depth maps, wait for acknowledgements, and others are lost.
    loopback = Path("/sys/class/net/lo/mtu")
    if not loopback.exists():
        pytest.skip("the size of a segment is told by Linux")
    assert Zmq.Params().send_buffer >= int(loopback.read_text())
    assert Zmq.Params().send_buffer == SEND_BUFFER
