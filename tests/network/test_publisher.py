"""Who has subscribed to what, also while somebody floods the publisher with subscriptions."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import zmq

from tactflow.network.publisher import MOST_EVENTS, Publisher

TOPIC = b"tactflow.main "
FLOOD = 5 * MOST_EVENTS


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    opened = Publisher("tcp://127.0.0.1:*", 32)
    yield opened
    opened.close(0)


def test_a_flood_of_subscriptions_is_read_in_parts_and_answers_stay_right(publisher: Publisher) -> None:
    with zmq.Context() as context, context.socket(zmq.SUB) as flood, context.socket(zmq.SUB) as reader:
        for socket in (flood, reader):
            socket.setsockopt(zmq.SNDHWM, 0)
            socket.linger = 0
            socket.connect(publisher.endpoint)
        for number in range(FLOOD):
            flood.subscribe(b"other %d" % number)
        grown = _read_until(publisher, FLOOD)
        assert 0 < max(grown) <= MOST_EVENTS
        assert not publisher.is_subscribed(TOPIC)
        reader.subscribe(b"tactflow.")
        _read_until(publisher, FLOOD + 1)
        assert publisher.is_subscribed(TOPIC)
        assert not publisher.is_subscribed(TOPIC, by_name=True)
        publisher.send(TOPIC + b"{}")
        assert reader.poll(5000)
        assert reader.recv() == TOPIC + b"{}"
        flood.close()
        _read_until(publisher, 1)
        reader.unsubscribe(b"tactflow.")
        _read_until(publisher, 0)
        assert not publisher.is_subscribed(TOPIC)


def _read_until(publisher: Publisher, count: int) -> list[int]:
    """Ask until so many subscriptions are there; how many came or went with each question."""
    steps, end = [], time.monotonic() + 60
    while publisher.subscriptions != count:
        assert time.monotonic() < end
        before = publisher.subscriptions
        publisher.is_subscribed(TOPIC)
        steps.append(abs(publisher.subscriptions - before))
    return steps
