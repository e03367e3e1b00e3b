"""The subscriber class and `tactflow listen`, against a real publisher."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
import zmq

from tactflow.cli import listen
from tactflow.cli.main import main
from tactflow.engine.frame import Frame, Tick
from tactflow.message.result import encode_message
from tactflow.network.remote_control import RemoteControl
from tactflow.network.subscriber import Subscriber
from tactflow.sinks.zmq import Zmq
from tactflow.vision.types import Contact, Flow, Markers
from tests.clock import PATIENCE
from tests.messages import Results, result_of

IMAGE = np.zeros((300, 400, 3), np.uint8)
CONTACT = Contact(5123.5, (150.2, 201.7), -12.31, 0.218, np.zeros((3, 2)), None)
FLOW = Flow((1.214, -0.33), 9)
MARKERS = Markers(np.zeros((3, 2)), np.zeros((3, 2)), np.array([0, 0, 2], np.uint8), np.zeros(3))
LONG = PATIENCE
"""How long a test waits for what must happen, s."""


class Publisher:
    """The real sink, with the sensor of each message chosen by the test."""

    def __init__(self, sensor: str = "main", **params: Any) -> None:
        self.sink = Zmq(Zmq.Params(**{"endpoint": "tcp://127.0.0.1:*", "backlog": 1000, **params}), sensor)
        self.sink.open()
        self.sensor = sensor
        self.endpoint = self.sink.endpoint

    def wait(self) -> None:
        """Until somebody has subscribed."""
        self.sink.wait_for_subscriber(LONG)
        assert self.sink.wants()

    def send(self, *seqs: int, contact: Contact | None = None) -> None:
        results = Results(IMAGE, contact, None if contact is None else FLOW, MARKERS)
        for seq in seqs:
            self.sink.write(result_of(Tick(Frame(self.sensor, seq, seq / 10, IMAGE)), results))


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    publisher = Publisher()
    yield publisher
    publisher.sink.close()


@pytest.mark.parametrize(
    ("seqs", "lost"),
    [([5, 6], 0), ([0, 2, 3, 7], 4), ([10, 0, 3], 2)],
    ids=["joined late", "gaps", "started again with a gap"],
)
def test_every_message_arrives_and_gaps_in_seq_are_counted_as_lost(
    seqs: list[int], lost: int, publisher: Publisher
) -> None:
    with Subscriber(publisher.endpoint, timeout=LONG) as messages:
        publisher.wait()
        publisher.send(*seqs, contact=CONTACT)
        received = list(islice(messages, len(seqs)))
        assert [result.seq for result in received] == seqs
        assert (messages.received, messages.lost) == (len(seqs), lost)
        assert received[0].contact is not None
        assert (received[0].contact.area, received[0].size) == (5123.5, (400, 300))


def test_latest_gives_the_newest_and_counts_what_it_skipped(publisher: Publisher) -> None:
    # The probe receives everything, so the test knows that the messages have left the publisher.
    with (
        Subscriber(publisher.endpoint, latest=True, timeout=LONG) as messages,
        Subscriber(publisher.endpoint, sensor="main", timeout=LONG) as probe,
    ):
        while publisher.sink.counters()["subscriptions"] < 2:
            publisher.wait()
        publisher.send(0)
        assert messages.receive().seq == 0
        publisher.send(*range(1, 100))
        for _ in range(100):
            last = probe.receive().seq
        assert last == 99
        seqs = [0]
        while seqs[-1] < 99:
            seqs.append(messages.receive().seq)
        assert seqs == sorted(set(seqs))
        assert messages.lost == 99 - (len(seqs) - 1)


@pytest.mark.parametrize("latest", [False, True])
def test_what_is_no_result_is_passed_over_and_counted_where_it_pretends_to_be_one(latest: bool) -> None:
    good = encode_message(result_of(Tick(Frame("main", 3, 0.1, IMAGE)), Results()))
    wrong_area = good.replace(b'"contact":null', b'"contact":{"area":"large"}')
    assert wrong_area != good
    with zmq.Context() as context, context.socket(zmq.XPUB) as foreign:
        foreign.linger = 0
        port = foreign.bind_to_random_port("tcp://127.0.0.1")
        with Subscriber(f"tcp://127.0.0.1:{port}", latest=latest, timeout=LONG) as messages:
            assert foreign.poll(1000 * LONG)
            foreign.recv()
            for _ in range(50):
                foreign.send_multipart([b"tactflow.main {}", b"second", b"third"])
            foreign.send(b'tactflow.stats {"frames": 7}')
            for body in (b"{", b'{"seq": []}', b"{}", wrong_area, good):
                foreign.send(b"tactflow.main " + body)
            assert messages.receive().seq == 3
            assert latest or (messages.malformed, messages.received) == (4, 5)


def test_a_sensor_can_be_chosen_and_its_name_is_matched_whole() -> None:
    publisher = Publisher("main2")
    with (
        Subscriber(publisher.endpoint, sensor="main", timeout=0.05) as shorter,
        Subscriber(publisher.endpoint, sensor="main2", timeout=LONG) as same,
    ):
        publisher.wait()
        publisher.send(0)
        assert same.receive().sensor == "main2"
        with pytest.raises(TimeoutError):
            shorter.receive()
    publisher.sink.close()


def test_silence_is_a_timeout_that_says_what_to_check(publisher: Publisher) -> None:
    with (
        Subscriber(publisher.endpoint, sensor="thumb", timeout=0.05) as messages,
        pytest.raises(TimeoutError, match=r"is tactflow running .* is its sensor called thumb"),
    ):
        messages.receive()
    with Subscriber(publisher.endpoint, timeout=LONG) as messages:
        publisher.wait()
        publisher.send(0)
        messages.receive()
        messages.timeout = 0.05
        with pytest.raises(TimeoutError, match="has the run ended"):
            next(iter(messages))


def test_a_subscriber_may_start_before_the_publisher_and_survives_its_restart() -> None:
    first = Publisher()
    first.sink.close()

    def run(seqs: list[int]) -> None:
        again = Publisher(endpoint=first.endpoint, wait_for_subscriber=LONG, linger=60)
        again.send(*seqs)
        again.sink.close()

    with Subscriber(first.endpoint, timeout=LONG) as messages:
        for seqs in ([3, 4], [0, 1]):
            # In a thread: a subscriber subscribes again only while it waits for messages.
            thread = threading.Thread(target=run, args=(seqs,))
            thread.start()
            assert [messages.receive().seq for _ in seqs] == seqs
            thread.join()
        assert messages.lost == 0


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"timeout": -1.0}, r"timeout: required None or 0 to 1e\+06 seconds, got -1"),
        ({"timeout": float("nan")}, "timeout: required"),
        ({"endpoint": "5556"}, "required an address such as tcp://127"),
    ],
)
def test_wrong_parameters_are_refused_with_what_is_required(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Subscriber(**wrong)


# -- tactflow listen --------------------------------------------------------------------------------------


def run_listen(publisher: Publisher, *words: str, send: Any) -> int:
    """Run `listen` here, and `send` in a thread once it has subscribed."""

    def publish() -> None:
        publisher.wait()
        send()

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        return main(["listen", publisher.endpoint, *words])
    finally:
        thread.join()


def test_listen_prints_one_readable_line_a_message(
    publisher: Publisher, capsys: pytest.CaptureFixture[str]
) -> None:
    def send() -> None:
        publisher.send(0)
        publisher.send(1, 4, contact=CONTACT)
        publisher.send(5, contact=replace(CONTACT, angle=None, slope=None))

    assert run_listen(publisher, "--count", "4", "--timeout", str(LONG), send=send) == 0
    out, err = capsys.readouterr()
    contact = (
        "contact 5124 px^2 at (150.2, 201.7)  angle -12.3 deg  flow (+1.21, -0.33) px (9 dots)  dots 2/3"
    )
    assert out.splitlines() == [
        "main 0  t 0.000 s  no contact  dots 2/3",
        f"main 1  t 0.100 s  {contact}",
        f"main 4  t 0.400 s  {contact}  (2 messages lost)",
        f"main 5  t 0.500 s  {contact.replace('angle -12.3 deg', 'no direction')}",
    ]
    assert err == ""


def test_listen_prints_the_messages_as_they_are(
    publisher: Publisher, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    words = ("--json", "--count", "2", "--timeout", str(LONG))
    assert run_listen(publisher, *words, send=lambda: publisher.send(0, 1)) == 0
    lines = capfdbinary.readouterr().out.splitlines()
    assert [json.loads(line)["seq"] for line in lines] == [0, 1]


def test_listen_reports_that_nothing_came(publisher: Publisher, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["listen", publisher.endpoint, "--timeout", "0.05"]) == 4
    assert "is tactflow running" in capsys.readouterr().err


def test_what_a_publisher_sends_commands_no_terminal() -> None:
    result = result_of(Tick(Frame("\x1b[2Jmain", 3, 0.1, IMAGE), skipped={"contact": "\x9b2J"}), Results())
    shown = listen.describe(result)
    assert "?[2Jmain 3" in shown
    assert "(?2J)" in shown


def has_ipv6() -> bool:
    """Whether this machine has the address ::1."""
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
def test_results_and_commands_go_over_ipv6_too() -> None:
    publisher = Publisher(endpoint="tcp://[::1]:*", control="tcp://[::1]:*")
    try:
        with Subscriber(publisher.endpoint, timeout=LONG) as messages:
            publisher.wait()
            publisher.send(0)
            assert messages.receive().seq == 0
        with RemoteControl(str(publisher.sink.control_endpoint), timeout=LONG) as run:
            assert run.ping()["message"] == "here"
    finally:
        publisher.sink.close()


def test_a_subscriber_that_falls_behind_says_so_once(
    publisher: Publisher, caplog: pytest.LogCaptureFixture
) -> None:
    with Subscriber(publisher.endpoint, timeout=LONG) as results:
        publisher.wait()
        thread = threading.Thread(target=lambda: [results.receive() for _ in range(2)])
        thread.start()
        publisher.send(100, 101)
        thread.join()
        # As if they had waited in the queue: older by more than a second than the one before.
        for seq, t in ((102, 9.3), (103, 8.9), (104, 8.8)):
            publisher.sink.write(result_of(Tick(Frame("main", seq, t, IMAGE)), Results(IMAGE)))
        queued = []
        for _ in range(3):
            assert results._socket.poll(1000 * LONG)
            queued.append(results.receive())
    assert [result.seq for result in queued] == [102, 103, 104]
    (said,) = [record.getMessage() for record in caplog.records if "behind" in record.getMessage()]
    assert "Subscriber(..., latest=True) skips to the newest result" in said


@pytest.mark.parametrize("latest", [False, True])
def test_a_subscriber_that_keeps_up_says_nothing(
    latest: bool, publisher: Publisher, caplog: pytest.LogCaptureFixture
) -> None:
    with Subscriber(publisher.endpoint, latest=latest, timeout=LONG) as results:
        publisher.wait()
        publisher.send(*range(100))
        while results.receive().seq < 99:
            pass
        # A new run begins anew.
        publisher.send(0)
        results.receive()
    assert not caplog.records
