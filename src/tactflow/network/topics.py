"""Publishes several topics on one socket, from any thread, and knows who has subscribed to which."""

from __future__ import annotations

import threading
import time

import zmq

from tactflow.network.publisher import Publisher


class TopicPublisher:
    """Sends each message as one frame, its topic first, to whoever has subscribed; never waits.

    Parameters, Raises : as of `Publisher`.

    Attributes
    ----------
    endpoint : the real address. subscriptions : distinct prefixes that somebody has subscribed to now.

    Examples
    --------
    >>> publisher = TopicPublisher("tcp://127.0.0.1:*", backlog=32, send_buffer=65536)
    >>> publisher.send(b"tactflow.main {}")
    >>> publisher.is_subscribed(b"tactflow.main ")
    False
    >>> publisher.close(linger=0)
    """

    def __init__(self, endpoint: str, backlog: int, send_buffer: int, keys: str | None = None) -> None:
        self._publisher = Publisher(endpoint, backlog, send_buffer, keys)
        self._closed = False
        # A socket belongs to one thread at a time.
        self._lock = threading.Lock()
        self.endpoint = self._publisher.endpoint
        self.subscriptions: frozenset[bytes] = frozenset()

    def is_subscribed(self, topic: bytes, *, by_name: bool = False) -> bool:
        """Whether anybody has subscribed to a topic or, unless `by_name`, to the beginning of it. Takes 3 us.

        topic : with the space that ends it. A subscription may be longer: it is a prefix of the message.
        """
        # While another thread sends, the last answer is good enough.
        if self._lock.acquire(blocking=False):
            try:
                self._read_events()
            finally:
                self._lock.release()
        name = topic.rstrip()
        return any(
            prefix.startswith(name if by_name else topic) or (not by_name and topic.startswith(prefix))
            for prefix in self.subscriptions
        )

    def wait_for(self, topic: bytes, seconds: float) -> bool:
        """Wait until somebody has subscribed to a topic, at most so long; whether somebody has."""
        end = time.monotonic() + seconds
        while not self.is_subscribed(topic) and (left := end - time.monotonic()) > 0:
            self._publisher.socket.poll(max(int(min(left, 0.1) * 1000), 1))
        return self.is_subscribed(topic)

    def send(self, message: bytes) -> None:
        """Send one message, which begins with its topic. Nothing after `close`."""
        with self._lock:
            if not self._closed:
                self._publisher.socket.send(message, zmq.NOBLOCK)

    def close(self, linger: float) -> None:
        """Deliver what is under way, for at most `linger` seconds, and free the address. May come twice."""
        with self._lock:
            self._closed = True
            self.subscriptions = frozenset()
        self._publisher.close(linger)

    def _read_events(self) -> None:
        while not self._closed and (event := self._publisher.next_event()) is not None:
            prefix = {event[1:]}
            if event[:1] == b"\x01":
                self.subscriptions |= prefix
            elif event[:1] == b"\x00":
                self.subscriptions -= prefix
