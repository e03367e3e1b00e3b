"""Connection to tactflow over ZeroMQ: receive messages, send commands."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import zmq
import zmq.auth
from zmq.utils.monitor import recv_monitor_message

POLL_MS = 100
"""Interval at which the thread checks for closing and for changed subscriptions, ms. Chosen by hand."""
MAX_QUEUED_MESSAGES = 120
"""Messages queued while this process is blocked: two seconds at 60 Hz. Chosen by hand."""
MAX_MESSAGE_BYTES = 16 << 20
"""Maximum size of a message. Chosen by hand."""
REJECTION_EVENTS = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""Handshake failures after which ZeroMQ does not reconnect."""
HANG_UP_EVENT = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
"""The server closed the connection during the handshake; ZeroMQ reconnects."""
MAX_HANG_UPS = 5
"""Consecutive hang-ups that count as a rejection; a server that ends causes one or two. Chosen by hand."""
REQUIRED_KEYS = frozenset(["sensor", "seq", "t", "contact", "flow", "markers"])
"""Keys that a result message must have."""


class LinkError(Exception):
    """Invalid address or keys; the message states the remedy."""


def connect(socket: zmq.Socket, endpoint: str, keys: str, what: str) -> None:
    """Connect without waiting for the publisher. keys : folder of the subscriber, or "". Raises LinkError."""
    socket.linger = 0
    socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
    # ZeroMQ accepts IPv6 addresses only with this option.
    socket.setsockopt(zmq.IPV6, endpoint.startswith("tcp://["))
    try:
        if keys:
            folder = Path(keys).expanduser()
            public, secret = zmq.auth.load_certificate(folder / "subscriber.key_secret")
            socket.curve_publickey, socket.curve_secretkey = public, secret
            socket.curve_serverkey, _ = zmq.auth.load_certificate(folder / "publisher.key")
        socket.connect(endpoint)
    except (OSError, ValueError) as error:
        raise LinkError(f"keys: {error}; tactflow keys new creates such a folder") from None
    except zmq.ZMQError as error:
        raise LinkError(
            f"{what}: required an address such as tcp://127.0.0.1:5556, got {endpoint!r}: {error.strerror}"
        ) from None


def send_command(endpoint: str, command: str, keys: str, seconds: float) -> tuple[bool, str]:
    """Send a command to tactflow; return whether it succeeded, and a message."""
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        try:
            connect(socket, endpoint, keys, "control")
        except LinkError as error:
            return False, str(error)
        socket.send_string(json.dumps({"do": command}))
        if not socket.poll(round(seconds * 1000)):
            return False, (
                f"no answer from {endpoint} within {seconds:g} s; is tactflow running with "
                "sinks.zmq.control set to it, and do the keys fit?"
            )
        try:
            answer = json.loads(socket.recv())
            return bool(answer["ok"]), str(answer["message"])
        except (ValueError, TypeError, KeyError, RecursionError):
            return False, f"{endpoint}: not an answer of tactflow"


class Link:
    """A thread that receives messages until it is closed.

    Parameters
    ----------
    endpoint, sensor : of tactflow.
    keys : folder, or "".
    on_message : called in the thread with the kind of message (`tactflow`, `tactflow_picture`,
        `tactflow_depth` or `stats`), its JSON, and the bytes after it.

    Raises
    ------
    LinkError : invalid endpoint, or unreadable keys.

    Attributes
    ----------
    refused : why tactflow rejected the connection, or None.
    damaged : number of unreadable messages.
    """

    def __init__(
        self,
        endpoint: str,
        sensor: str,
        keys: str,
        on_message: Callable[[str, dict[str, Any], bytes], None],
    ) -> None:
        self.refused: str | None = None
        self.damaged = 0
        self._endpoint = endpoint
        self._sensor = sensor
        self._on_message = on_message
        self._topics = {
            "tactflow": f"tactflow.{sensor} ".encode(),
            "tactflow_picture": f"tactflow_picture.{sensor} ".encode(),
            "tactflow_depth": f"tactflow_depth.{sensor} ".encode(),
            "stats": b"tactflow.stats ",
        }
        self._wanted: frozenset[str] = frozenset(["tactflow", "stats"])
        self._subscribed: set[str] = set()
        self._closing = threading.Event()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.rcvhwm = MAX_QUEUED_MESSAGES
        # Heartbeats detect a publisher that disappeared without closing its connection, and reconnect.
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, 2000)
        self._monitor = self._socket.get_monitor_socket(
            REJECTION_EVENTS | HANG_UP_EVENT | zmq.EVENT_HANDSHAKE_SUCCEEDED
        )
        self._hang_ups = 0
        try:
            connect(self._socket, endpoint, keys, "endpoint")
        except LinkError:
            self._end()
            raise
        self._thread = threading.Thread(target=self._receive, name="tactflow-link", daemon=True)
        self._thread.start()

    def want(self, extra: Iterable[str]) -> None:
        """Set the additional topics to receive, such as `tactflow_picture`; takes effect within `POLL_MS`."""
        self._wanted = frozenset(["tactflow", "stats", *extra])

    def close(self) -> None:
        """Stop receiving."""
        self._closing.set()
        self._thread.join()
        self._end()

    def _end(self) -> None:
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close(0)
        self._context.term()

    def _receive(self) -> None:
        """Body of the thread."""
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        while not self._closing.is_set():
            self._subscribe()
            ready = dict(poller.poll(POLL_MS))
            if self._monitor in ready:
                self._note_handshake(recv_monitor_message(self._monitor)["event"])
            if self._socket in ready:
                self._pass_on(self._socket.recv())

    def _note_handshake(self, event: int) -> None:
        self._hang_ups = self._hang_ups + 1 if event == HANG_UP_EVENT else 0
        if event & REJECTION_EVENTS or self._hang_ups >= MAX_HANG_UPS:
            self.refused = f"{self._endpoint} requires other keys, or any: set the parameter keys"
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self.refused = None

    def _subscribe(self) -> None:
        wanted = self._wanted
        for name in wanted - self._subscribed:
            self._socket.subscribe(self._topics[name])
        for name in self._subscribed - wanted:
            self._socket.unsubscribe(self._topics[name])
        self._subscribed = set(wanted)

    def _pass_on(self, received: bytes) -> None:
        topic, _, body = received.partition(b" ")
        text, _, rest = body.partition(b"\n")
        name = topic.decode(errors="replace")
        name = "stats" if name == "tactflow.stats" else name.partition(".")[0]
        try:
            message = json.loads(text)
            ours = message["sensor"] == self._sensor
            if name == "tactflow" and not message.keys() >= REQUIRED_KEYS:
                raise ValueError("not a result message")
            if ours:
                self._on_message(name, message, rest)
        except Exception:
            # An invalid message must not end the thread. (rclpy asserts ranges of numbers.)
            self.damaged += 1
