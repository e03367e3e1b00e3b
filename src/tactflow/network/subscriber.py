"""A subscriber for programs that use what a running tactflow publishes.

>>> from tactflow.network.subscriber import Subscriber
>>> with Subscriber(latest=True, timeout=5) as messages:      # doctest: +SKIP
...     for message in messages:
...         print(message["seq"], message["contact"])

Nothing here needs OpenCV or the rest of tactflow: the same few lines work over plain ZeroMQ in any language.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import orjson
import zmq

from tactflow.network.connection import Connection
from tactflow.system.clock import SYSTEM, Clock

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5556"
"""Where tactflow publishes unless its pipeline says otherwise."""

LONGEST_WAIT = 3600.0
"""ZeroMQ counts in milliseconds and not for ever; longer waits are made of several of these, s."""

HEARTBEAT_MS = 2000
"""Time between two questions whether the publisher is alive, ms. Chosen by hand."""
FIRST_RETRY_MS = 50
LAST_RETRY_MS = 250
"""Time between attempts to connect again, which doubles from the first to the last: after a pause of the
publisher, be back within a quarter of a second. Chosen by hand, ms."""

LONGEST_MESSAGE = 16 << 20
"""Bytes of a message at most; one with 140 dots has about 14,000. Whoever sends longer ones is no tactflow,
and is heard no more, before memory is taken for it. Chosen by hand."""

LARGEST_BACKLOG = 2**31 - 1
"""ZeroMQ takes it as an `int` of C; 0 would be no limit to it."""

MOST_SENSORS = 1000
"""Sensors whose gaps are counted, so that invented names take no memory. Chosen by hand."""

STATISTICS = b"tactflow.stats"
"""Topic of a run's statistics, which no sensor may be called after."""


REQUIRED = frozenset(["schema", "sensor", "seq", "t", "contact", "flow", "markers", "skipped"])
"""Keys that every result message has."""


class Subscriber(Connection):
    """Receives result messages (`tactflow.frame/1`) as dicts; a context manager and an iterator.

    Belongs to one thread at a time. Connecting does not wait: it does not matter whether tactflow is started
    before or after; only messages published after the connection stands are received.

    Parameters
    ----------
    endpoint : address that tactflow publishes on.
    sensor : receive only this sensor; None for all.
    latest : keep only the newest message: for control loops, which want the present and not what is waiting.
        Otherwise messages wait until they are read.
    timeout : s without any message after which waiting ends in a TimeoutError; None waits for ever.
    clock : tells when the timeout is over.
    backlog : messages that may wait until they are read, without `latest`; what comes then is lost, and
        counted. 10,000 are nearly three minutes at 60 Hz, and some 140 MB.
    keys : the subscriber's folder that `tactflow keys new` makes, where the publisher asks for keys.

    Attributes
    ----------
    lost : frames missing between the messages received so far, told by gaps in `seq`: those that tactflow
        dropped to stay live, those that did not fit a queue on the way, and with `latest` those skipped.
    received : messages received so far.
    malformed : of these, ones that were no result messages: somebody else publishes there.

    Raises
    ------
    ValueError
        If the endpoint is no address, the folder has no keys, or timeout or backlog is no such number.

    Examples
    --------
    >>> with Subscriber("tcp://127.0.0.1:5556", latest=True, timeout=5) as messages:
    ...     messages.received, messages.lost  # `for message in messages:` waits for them
    (0, 0)
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        sensor: str | None = None,
        latest: bool = False,
        timeout: float | None = None,
        clock: Clock = SYSTEM,
        backlog: int = 10_000,
        keys: str | Path | None = None,
    ) -> None:
        if timeout is not None and not timeout >= 0:
            raise ValueError(f"timeout: required None or a number of seconds from 0, got {timeout}")
        if not 1 <= backlog <= LARGEST_BACKLOG:
            raise ValueError(f"backlog: required 1 to {LARGEST_BACKLOG} messages, got {backlog}")
        self._clock = clock
        self.timeout = timeout
        self.lost = 0
        self.received = 0
        self.malformed = 0
        self._sensor = sensor
        self._last_seq: dict[str, int] = {}
        kept: dict[int, int | bytes] = {zmq.CONFLATE: 1} if latest else {zmq.RCVHWM: backlog}
        options = kept | {
            zmq.RECONNECT_IVL: FIRST_RETRY_MS,
            zmq.RECONNECT_IVL_MAX: LAST_RETRY_MS,
            # A publisher that has lost its power says no goodbye; without a sign of life it is sought again.
            zmq.HEARTBEAT_IVL: HEARTBEAT_MS,
            zmq.HEARTBEAT_TIMEOUT: 3 * HEARTBEAT_MS,
            zmq.MAXMSGSIZE: LONGEST_MESSAGE,
            # The space ends the topic: `main` is not to receive `main2`.
            zmq.SUBSCRIBE: b"tactflow." if sensor is None else f"tactflow.{sensor} ".encode(),
        }
        super().__init__(zmq.SUB, endpoint, options, keys)

    def receive(self) -> dict[str, Any]:
        """The next message; waits for it. What is no result message is passed over and counted.

        Raises
        ------
        TimeoutError
            If nothing comes for `timeout` seconds.
        PermissionError
            If the publisher does not admit us: it asks for keys, or for others.
        """
        while True:
            message = _parsed(self.receive_json())
            if message is not None:
                self._count(message["sensor"], message["seq"])
                return message
            self.malformed += 1

    def receive_json(self) -> bytes:
        """The next message as it was sent, JSON in UTF-8; not counted in `lost`. Raises as `receive`."""
        deadline = None if self.timeout is None else self._clock.now() + self.timeout
        while True:
            left = math.inf if deadline is None else deadline - self._clock.now()
            if not self._wait(min(left, LONGEST_WAIT)):
                if left <= LONGEST_WAIT:
                    raise TimeoutError(self._silence())
                continue
            # Not every message that shares the beginning of our topic is a result: there are statistics too.
            topic, _, body = self._socket.recv().partition(b" ")
            if body.startswith(b"{") and topic != STATISTICS:
                self.received += 1
                return body

    def _silence(self) -> str:
        what = f"no message from {self.endpoint} for {self.timeout:g} s"
        if self.received:
            return f"{what}; has the run ended?"
        hint = "is tactflow running and publishing there"
        named = f", and is its sensor called {self._sensor}" if self._sensor else ""
        known = ", and are these keys for it" if self._has_keys else ""
        return f"{what}; {hint}{named}{known}?"

    def _count(self, sensor: str, seq: int) -> None:
        last = self._last_seq.get(sensor)
        # A smaller number than before means that tactflow was started again.
        if last is not None and seq > last + 1:
            self.lost += seq - last - 1
        if last is not None or len(self._last_seq) < MOST_SENSORS:
            self._last_seq[sensor] = seq

    def __iter__(self) -> Iterator[dict[str, Any]]:
        while True:
            yield self.receive()


def _parsed(body: bytes) -> dict[str, Any] | None:
    """A result message, or None if it is none."""
    try:
        message = orjson.loads(body)
    except ValueError:
        return None
    return message if isinstance(message, dict) and _is_result(message) else None


def _is_result(message: dict[str, Any]) -> bool:
    """Whether what programs rely on is there and of its type; there may be more."""
    if not message.keys() >= REQUIRED:
        return False
    contact, flow, markers = message["contact"], message["flow"], message["markers"]
    return (
        isinstance(message["sensor"], str)
        and isinstance(message["seq"], int)
        and _is_number(message["t"])
        and isinstance(message["skipped"], dict)
        and (contact is None or (isinstance(contact, dict) and _is_contact(contact)))
        and (flow is None or (isinstance(flow, dict) and _is_flow(flow)))
        and (markers is None or (isinstance(markers, dict) and _are_markers(markers)))
    )


def _is_contact(contact: dict[str, Any]) -> bool:
    return (
        _is_number(contact.get("area"))
        and _is_pair(contact.get("center"))
        and all(contact.get(key, "") is None or _is_number(contact.get(key)) for key in ("angle", "slope"))
        and isinstance(contact.get("hull"), list)
    )


def _is_flow(flow: dict[str, Any]) -> bool:
    mean = flow.get("mean", "")
    return isinstance(flow.get("count"), int) and (mean is None or _is_pair(mean))


def _are_markers(markers: dict[str, Any]) -> bool:
    return all(isinstance(markers.get(key), list) for key in ("origin", "position", "status"))


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
