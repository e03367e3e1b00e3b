"""ZeroMQ sockets that a run binds: for results, by the sink `zmq` or the relay of several sensors."""

from __future__ import annotations

import errno
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import zmq

from tactflow.engine.errors import StageError
from tactflow.network.address import Address
from tactflow.network.keys import require_keys
from tactflow.system.files import expanded

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

SERVER_OPTIONS: dict[int, int] = {
    # Largest subscription or command, bytes; usual ones have some twenty. ZeroMQ keeps subscriptions in a
    # tree and recurses once per byte: a subscription of a megabyte overflows the stack.
    zmq.MAXMSGSIZE: 4096,
    # Handshake timeout, ms. Chosen by hand.
    zmq.HANDSHAKE_IVL: 5000,
    # Idle time before the first keep-alive probe, s. Chosen by hand.
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 10,
}
SEND_BUFFER_BYTES = 65_536
"""Kernel send buffer per subscriber, bytes: one segment of the loopback device, as messages longer than the
buffer wait for delayed acknowledgements (depth maps took 0.3 s each with 32 kB). Larger ones hold more stale
messages."""
_READABLE = int(zmq.POLLIN)
"""As a plain number: an operation with the `enum` takes 25 us."""
_HINT = (
    "another tactflow run, or another program, publishes there. End it, choose another address "
    "(--set sinks.zmq.endpoint=tcp://127.0.0.1:5557) or publish nothing (--set sinks.zmq=null)"
)


class BoundSocket:
    """A bound socket and, if keys are required, its authenticator.

    Parameters
    ----------
    kind : ZeroMQ's type of the socket.
    hint : advice if the address is in use.
    options : ZeroMQ's option -> value.
    keys : the publisher's folder made by `tactflow keys new`: only clients with a key in it are admitted,
        and everything is encrypted. None admits every client that can reach the address.
    endpoint : the bound address, with the actual port.

    Attributes
    ----------
    socket : to be used by one thread at a time.

    Raises
    ------
    StageError : the address is invalid, in use or cannot be bound, or the keys are wrong.
    """

    def __init__(
        self, kind: int, endpoint: str, hint: str, options: Mapping[int, int], keys: str | None = None
    ) -> None:
        self._authenticator: ThreadAuthenticator | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(kind)
        try:
            address = Address.parse(endpoint)
            # ZeroMQ accepts an IPv6 address only with this option.
            for option, value in {zmq.IPV6: ":" in str(address.host), **SERVER_OPTIONS, **options}.items():
                self.socket.setsockopt(option, value)
            if keys is not None:
                self._authenticator = require_keys(self.socket, self._context, expanded(keys))
            if address.host is None:
                _refuse_taken_path(Path(endpoint.removeprefix("ipc://")))
            self.socket.bind(endpoint)
        except ValueError as error:
            BoundSocket.close(self)
            raise StageError(str(error)) from error
        except zmq.ZMQError as error:
            BoundSocket.close(self)
            is_taken = error.errno == errno.EADDRINUSE
            reason = f"is in use: {hint}" if is_taken else f"cannot be bound: {error.strerror}"
            raise StageError(f"{endpoint} {reason}") from error
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def close(self, linger: float = 0.0) -> None:
        """Deliver pending messages for at most `linger` seconds, then free the address. Idempotent."""
        if self._authenticator is not None:
            self._authenticator.stop()
            self._authenticator = None
        self.socket.close(linger=int(linger * 1000))
        self._context.term()


def _refuse_taken_path(path: Path) -> None:
    """Refuse the path of a file or of another run's socket: ZeroMQ would delete it."""
    if sys.platform == "win32" or not path.exists():
        return
    if not path.is_socket():
        raise ValueError(f"ipc://{path}: {path} is a file; an address needs an unused path")
    with socket.socket(socket.AF_UNIX) as probe:
        # A socket left behind by a killed run refuses the connection, and may be replaced.
        if probe.connect_ex(str(path)) == 0:
            raise zmq.ZMQError(errno.EADDRINUSE)


class Publisher(BoundSocket):
    """A bound XPUB socket. Any thread may send; sending never waits for subscribers.

    Parameters
    ----------
    backlog : messages queued for each subscriber at most.

    Attributes
    ----------
    subscriptions : number of distinct prefixes.
    """

    def __init__(self, endpoint: str, backlog: int, keys: str | None = None) -> None:
        # A socket belongs to one thread at a time.
        self._lock = threading.Lock()
        self._topics: Counter[bytes] = Counter()
        self.subscriptions = 0
        super().__init__(
            zmq.XPUB, endpoint, _HINT, {zmq.SNDHWM: backlog, zmq.SNDBUF: SEND_BUFFER_BYTES}, keys
        )

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
        """Count the subscriptions to each topic."""
        while (event := self.next_event()) is not None:
            topic, space, _ = event[1:].partition(b" ")
            change = {b"\x01": 1, b"\x00": -1}.get(event[:1], 0)
            self._topics[topic + space] += change
            self.subscriptions += change
            if self._topics[topic + space] == 0:
                del self._topics[topic + space]

    def wait_for(self, topic: bytes, seconds: float) -> bool:
        """Wait for a subscription to a topic; returns whether there is one."""
        end = time.monotonic() + seconds
        while not self.is_subscribed(topic) and time.monotonic() < end:
            self.socket.poll(10)
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
