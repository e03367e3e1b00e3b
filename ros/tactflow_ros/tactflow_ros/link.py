"""The way to tactflow over ZeroMQ: its messages, and commands to it."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import zmq
import zmq.auth

POLL_MS = 100
"""How often the thread looks whether it shall end, and what is wanted, ms. Chosen by hand."""
BACKLOG = 120
"""Messages that may wait while this process stands still: two seconds at 60 Hz. Chosen by hand."""
LONGEST_MESSAGE = 16 << 20
"""Bytes of a message at most. Chosen by hand."""
REFUSALS = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""After these, ZeroMQ does not try again."""
REQUIRED = frozenset(["sensor", "seq", "t", "contact", "flow", "markers"])
"""Keys that a result message must have."""


class LinkError(Exception):
    """tactflow cannot be reached so; says what to do."""


def show_keys(socket: zmq.Socket, folder: str) -> None:
    """Let a socket prove who it is. folder : the subscriber's, that `tactflow keys new` makes; "": none."""
    if not folder:
        return
    place = Path(folder).expanduser()
    try:
        public, secret = zmq.auth.load_certificate(place / "subscriber.key_secret")
        server, _ = zmq.auth.load_certificate(place / "publisher.key")
    except (OSError, ValueError) as error:
        raise LinkError(f"keys: {error}; tactflow keys new makes such a folder") from None
    socket.curve_publickey, socket.curve_secretkey = public, secret
    socket.curve_serverkey = server


def connect(socket: zmq.Socket, endpoint: str, keys: str, what: str) -> None:
    """Connect, which does not wait for the other side.

    Raises
    ------
    LinkError : no address, or no keys.
    """
    socket.linger = 0
    socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_MESSAGE)
    # ZeroMQ takes addresses of IPv6 only where it is told to.
    socket.setsockopt(zmq.IPV6, endpoint.startswith("tcp://["))
    show_keys(socket, keys)
    try:
        socket.connect(endpoint)
    except zmq.ZMQError as error:
        raise LinkError(
            f"{what}: required an address such as tcp://127.0.0.1:5556, got {endpoint!r}: {error.strerror}"
        ) from None


def ask(endpoint: str, command: str, keys: str, seconds: float) -> tuple[bool, str]:
    """Send a command to tactflow; whether it was carried out, and what happened in words."""
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
        except (ValueError, TypeError, KeyError):
            return False, f"{endpoint} does not answer as tactflow does"


class Link:
    """A thread that receives, until it is closed.

    endpoint, sensor : of tactflow. keys : folder, or "". on_message : is called in the thread with a topic's
    first word (`tactflow`, `tactflow_picture`, `tactflow_depth`, or `stats`), the JSON of a message, and what
    follows it.

    Raises
    ------
    LinkError : the endpoint is no address, or there are no keys.

    Attributes
    ----------
    refused : why tactflow does not admit us; None while it has not said so. damaged : messages that could
    not be read.
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
        self._socket.rcvhwm = BACKLOG
        # A publisher that has lost its power says no goodbye; without a sign of life it is sought again.
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, 2000)
        self._monitor = self._socket.get_monitor_socket(REFUSALS)
        try:
            connect(self._socket, endpoint, keys, "endpoint")
        except LinkError:
            self._end()
            raise
        self._thread = threading.Thread(target=self._receive, name="tactflow-link", daemon=True)
        self._thread.start()

    def want(self, extra: Iterable[str]) -> None:
        """Also receive these, such as `tactflow_picture`; a moment later."""
        self._wanted = frozenset(["tactflow", "stats", *extra])

    def close(self) -> None:
        """Receive no more."""
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
                self._monitor.recv_multipart()
                self.refused = f"{self._endpoint} asks for keys, or for others: set the parameter keys"
            if self._socket in ready:
                self._pass_on(self._socket.recv())

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
            if name == "tactflow" and not message.keys() >= REQUIRED:
                raise ValueError("no result message")
            if ours:
                self._on_message(name, message, rest)
        except Exception:
            # Whatever a message says, the next one shall be received. (rclpy asserts ranges of numbers.)
            self.damaged += 1
