"""The socket that results are published on: by the sink `zmq`, and by the relay of several sensors."""

from __future__ import annotations

import threading
import time
from collections import Counter
from functools import cache

import zmq

from tactflow.network.bound_socket import BoundSocket

SEND_BUFFER = 65_536
"""Kernel send buffer per subscriber, bytes. One segment of the loopback device:
longer messages than the buffer wait for delayed acknowledgements. With 32 kB, depth maps of 480 kB at 30 Hz
took 0.3 s each, and 43 % of the results beside them arrived (147 of 345; with 64 kB 350 of 350). Larger ones
hold more stale messages."""
MOST_EVENTS = 1000
"""Subscriptions read at a time, in about 2 ms. Chosen by hand."""
_READABLE = int(zmq.POLLIN)
"""As a plain number: an operation with the `enum` takes 25 us."""
_HINT = (
    "another tactflow run, or another program, publishes there. End it, choose another address "
    "(--set sinks.zmq.endpoint=tcp://127.0.0.1:5557) or publish nothing (--set sinks.zmq=null)"
)


class Publisher(BoundSocket):
    """A bound XPUB socket. Any thread may send; sending never waits for subscribers.

    endpoint, keys, Raises : as for `BoundSocket`. backlog : messages queued for each subscriber at most.
    subscriptions : number of distinct prefixes that are subscribed to.

    >>> publisher = Publisher("tcp://127.0.0.1:*", backlog=32)
    >>> publisher.send(b"tactflow.main {}")
    >>> publisher.is_subscribed(b"tactflow.main ")
    False
    >>> publisher.close()
    """

    def __init__(self, endpoint: str, backlog: int, keys: str | None = None) -> None:
        # A socket belongs to one thread at a time.
        self._lock = threading.Lock()
        self._topics: Counter[bytes] = Counter()
        self.subscriptions = 0
        super().__init__(zmq.XPUB, endpoint, _HINT, {zmq.SNDHWM: backlog, zmq.SNDBUF: SEND_BUFFER}, keys)

    def next_event(self) -> bytes | None:
        """The next subscription (1 and the prefix) or its end (0 and the prefix), or None; never waits."""
        if not self.socket.closed and int(self.socket.getsockopt(zmq.EVENTS)) & _READABLE:
            return self.socket.recv(zmq.NOBLOCK)
        return None

    def is_subscribed(self, topic: bytes, *, by_name: bool = False) -> bool:
        """Whether there is a subscription to a topic or, unless `by_name`, to a prefix of it. Takes 3 us.

        topic : including the space at its end. A subscription may be longer: it is a prefix of the message.
        """
        # While another thread sends, the last known subscriptions are good enough.
        if self._lock.acquire(blocking=False):
            try:
                self._read_events()
            finally:
                self._lock.release()
        return not self._topics.keys().isdisjoint(_beginnings(topic, len(topic) - 1 if by_name else 0))

    def _read_events(self) -> None:
        """Count subscriptions by topic, at most `MOST_EVENTS` changes at a time."""
        for _ in range(MOST_EVENTS):
            event = self.next_event()
            if event is None:
                return
            topic, space, _ = event[1:].partition(b" ")
            change = {b"\x01": 1, b"\x00": -1}.get(event[:1], 0)
            self._topics[topic + space] += change
            self.subscriptions += change
            if self._topics[topic + space] == 0:
                del self._topics[topic + space]

    def wait_for(self, topic: bytes, seconds: float) -> bool:
        """Wait for a subscription to a topic; returns whether there is one."""
        end = time.monotonic() + seconds
        while not self.is_subscribed(topic) and (remaining := end - time.monotonic()) > 0:
            self.socket.poll(max(int(min(remaining, 0.1) * 1000), 1))
        return self.is_subscribed(topic)

    def send(self, message: bytes) -> None:
        """Send a message, which begins with its topic; ignored after `close`."""
        with self._lock:
            if not self.socket.closed:
                self.socket.send(message, zmq.NOBLOCK)

    def close(self, linger: float = 0.0) -> None:
        """Deliver pending messages for at most `linger` seconds, then free the address. Idempotent."""
        with self._lock:
            self._topics.clear()
            self.subscriptions = 0
            super().close(linger)


@cache
def _beginnings(topic: bytes, shortest: int) -> frozenset[bytes]:
    return frozenset(topic[:length] for length in range(shortest, len(topic) + 1))
