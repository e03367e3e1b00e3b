"""The socket that results are published on: by the sink `zmq`, and by the relay of several sensors."""

from __future__ import annotations

import threading
import time
from typing import NamedTuple

import zmq

from tactflow.network.bound_socket import BoundSocket

SEND_BUFFER = 65_536
"""Kernel send buffer per subscriber unless the pipeline sets it, bytes. One segment of the loopback device:
longer messages than the buffer wait for delayed acknowledgements. With 32 kB, depth maps of 480 kB at 30 Hz
took 0.3 s each, and 43 % of the results beside them arrived (147 of 345; with 64 kB 350 of 350). Larger ones
hold more stale messages."""
MOST_EVENTS = 1000
"""Subscriptions that are read at once, in about 2 ms. Chosen by hand."""
_READABLE = int(zmq.POLLIN)
"""As a plain number: an operation with the `enum` takes 25 us."""
_HINT = (
    "another tactflow run, or another program, publishes there. End it, choose another address "
    "(--set sinks.zmq.endpoint=tcp://127.0.0.1:5557) or publish nothing (--set sinks.zmq=null)"
)


class Publisher(BoundSocket):
    """A bound XPUB socket: sends from any thread to whoever has subscribed, and never waits for them.

    endpoint, keys, Raises : as for `BoundSocket`. backlog : messages that may wait for each subscriber.
    send_buffer : the kernel's, per subscriber, bytes.

    >>> publisher = Publisher("tcp://127.0.0.1:*", backlog=32, send_buffer=65536)
    >>> publisher.send(b"tactflow.main {}")
    >>> publisher.is_subscribed(b"tactflow.main ")
    False
    >>> publisher.close()
    """

    def __init__(self, endpoint: str, backlog: int, send_buffer: int, keys: str | None = None) -> None:
        # A socket belongs to one thread at a time.
        self._lock = threading.Lock()
        self._prefixes: set[bytes] = set()
        # How many subscriptions match each question: counted when one comes or goes, since anybody may
        # subscribe a hundred thousand times.
        self._matches: dict[_Question, int] = {}
        super().__init__(zmq.XPUB, endpoint, _HINT, {zmq.SNDHWM: backlog, zmq.SNDBUF: send_buffer}, keys)

    def next_event(self) -> bytes | None:
        """The next subscription (1 and its prefix) or its end (0 and the prefix); None. Never waits."""
        if not self.socket.closed and int(self.socket.getsockopt(zmq.EVENTS)) & _READABLE:
            return self.socket.recv(zmq.NOBLOCK)
        return None

    def is_subscribed(self, topic: bytes, *, by_name: bool = False) -> bool:
        """Whether anybody has subscribed to a topic or, unless `by_name`, to the beginning of it. Takes 3 us.

        topic : with the space that ends it. A subscription may be longer: it is a prefix of the message.
        """
        question = _Question(topic, by_name)
        # While another thread sends, the last answer is good enough.
        if self._lock.acquire(blocking=question not in self._matches):
            try:
                self._read_events()
                if question not in self._matches:
                    self._matches[question] = sum(map(question.is_met_by, self._prefixes))
            finally:
                self._lock.release()
        return self._matches[question] > 0

    @property
    def subscriptions(self) -> int:
        """How many distinct prefixes are subscribed to."""
        return len(self._prefixes)

    def _read_events(self) -> None:
        """Read subscriptions that have come since the last time; a flood of them in parts."""
        for _ in range(MOST_EVENTS):
            event = self.next_event()
            if event is None:
                return
            subscribed, prefix = event[:1] == b"\x01", event[1:]
            if event[:1] not in (b"\x00", b"\x01") or subscribed == (prefix in self._prefixes):
                continue
            (self._prefixes.add if subscribed else self._prefixes.discard)(prefix)
            for question in self._matches:
                self._matches[question] += question.is_met_by(prefix) * (1 if subscribed else -1)

    def wait_for(self, topic: bytes, seconds: float) -> bool:
        """Wait until somebody has subscribed to a topic, at most so long; whether somebody has."""
        end = time.monotonic() + seconds
        while not self.is_subscribed(topic) and (left := end - time.monotonic()) > 0:
            self.socket.poll(max(int(min(left, 0.1) * 1000), 1))
        return self.is_subscribed(topic)

    def send(self, message: bytes) -> None:
        """Send one message, which begins with its topic. Nothing after `close`."""
        with self._lock:
            if not self.socket.closed:
                self.socket.send(message, zmq.NOBLOCK)

    def close(self, linger: float = 0.0) -> None:
        """Deliver what is under way, for at most `linger` seconds, and free the address. May come twice."""
        with self._lock:
            self._prefixes.clear()
            self._matches = dict.fromkeys(self._matches, 0)
            super().close(linger)


class _Question(NamedTuple):
    topic: bytes
    by_name: bool

    def is_met_by(self, prefix: bytes) -> bool:
        if self.by_name:
            return prefix.startswith(self.topic.rstrip())
        return prefix.startswith(self.topic) or self.topic.startswith(prefix)
