"""A subscriber for programs that use what a running tactflow publishes.

>>> from tactflow.network.subscriber import Subscriber
>>> with Subscriber(latest=True, timeout=5) as results:      # doctest: +SKIP
...     for result in results:
...         print(result.seq, result.contact)

Any ZeroMQ library in any language can do the same: a message is a topic, a space, and JSON.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import zmq

from tactflow.message.result import Result
from tactflow.network.connection import Connection
from tactflow.system.clock import SYSTEM, Clock

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5556"
"""Where tactflow publishes unless its pipeline says otherwise."""

LONGEST_WAIT = 1e6
"""Longest timeout, s (11 days): ZeroMQ counts milliseconds in 31 bits."""

HEARTBEAT_MS = 2000
"""Time between two questions whether the publisher is alive, ms. Chosen by hand."""
FIRST_RETRY_MS = 50
LAST_RETRY_MS = 250
"""Back-off between attempts to reconnect, ms, doubled from the first to the last: after the publisher has
paused, the connection is back within a quarter of a second. Chosen by hand."""

LONGEST_MESSAGE = 16 << 20
"""Longest message, bytes; one with 140 dots has about 14,000. The connection to a publisher that sends a
longer one is closed before memory is taken for it. Chosen by hand."""

LARGEST_BACKLOG = 2**31 - 1
"""ZeroMQ takes it as an `int` of C; 0 would mean no limit."""

STATISTICS = b"tactflow.stats"
"""Topic of a run's statistics; no sensor may have its name."""


class Subscriber(Connection):
    """Receives results from a running tactflow; a context manager and an iterator of `Result`.

    Belongs to one thread at a time. Connecting does not wait: it does not matter whether tactflow is started
    before or after; only messages published after the connection stands are received. A received result has
    what its message has: no pictures, masks or height maps. `result.to_dict()` is the message itself.

    Parameters
    ----------
    endpoint : address that tactflow publishes on.
    sensor : receive only this sensor; None for all.
    latest : skip to the newest message that waits: for control loops, which want the present. Otherwise
        messages are received in turn.
    timeout : s without any message after which waiting ends in a TimeoutError, 1e6 at most; None waits for
        ever.
    clock : measures the timeout.
    backlog : messages that may wait until they are read; what comes then is lost, and counted. 10,000 are
        nearly three minutes at 60 Hz, and some 140 MB.
    keys : the subscriber's folder that `tactflow keys new` makes, where the publisher asks for keys.

    Attributes
    ----------
    lost : frames missing between the results received so far, known from gaps in `seq`: those that tactflow
        dropped to stay live, those that did not fit a queue on the way, and with `latest` those skipped.
    received : messages received so far.
    malformed : of these, ones that were not result messages: another program publishes there.

    Raises
    ------
    ValueError
        If the endpoint is not an address, the folder has no keys, or timeout or backlog is out of range.

    Examples
    --------
    >>> with Subscriber("tcp://127.0.0.1:5556", latest=True, timeout=5) as results:
    ...     results.received, results.lost  # `for result in results:` waits for them
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
        if timeout is not None and not 0 <= timeout <= LONGEST_WAIT:
            raise ValueError(f"timeout: required None or 0 to {LONGEST_WAIT:g} seconds, got {timeout}")
        if not 1 <= backlog <= LARGEST_BACKLOG:
            raise ValueError(f"backlog: required 1 to {LARGEST_BACKLOG} messages, got {backlog}")
        self._clock = clock
        self.timeout = timeout
        self.lost = 0
        self.received = 0
        self.malformed = 0
        self._sensor = sensor
        self._last_seq: dict[str, int] = {}
        # Not zmq.CONFLATE, with which a message of several parts aborts the process.
        self._skipped_at_most = backlog if latest else 0
        options: dict[int, int | bytes] = {
            zmq.RCVHWM: backlog,
            zmq.RECONNECT_IVL: FIRST_RETRY_MS,
            zmq.RECONNECT_IVL_MAX: LAST_RETRY_MS,
            # A publisher that has lost its power says no goodbye.
            zmq.HEARTBEAT_IVL: HEARTBEAT_MS,
            zmq.HEARTBEAT_TIMEOUT: 3 * HEARTBEAT_MS,
            zmq.MAXMSGSIZE: LONGEST_MESSAGE,
            # The space ends the topic: `main` must not receive `main2`.
            zmq.SUBSCRIBE: b"tactflow." if sensor is None else f"tactflow.{sensor} ".encode(),
        }
        super().__init__(zmq.SUB, endpoint, options, keys)

    def receive(self) -> Result:
        """Wait for the next result. Messages that are not results are passed over and counted.

        Raises
        ------
        TimeoutError
            If nothing comes for `timeout` seconds.
        PermissionError
            If the publisher does not admit us: it asks for keys, or for others.
        """
        while True:
            try:
                result = Result.from_message(self.receive_json())
            except ValueError:
                self.malformed += 1
                continue
            self._count(result.sensor, result.seq)
            return result

    def receive_json(self) -> bytes:
        """Wait for the next message: JSON in UTF-8; not counted in `lost`. Raises as `receive`."""
        deadline = math.inf if self.timeout is None else self._clock.now() + self.timeout
        while True:
            left = deadline - self._clock.now()
            if self._wait(min(max(left, 0.0), LONGEST_WAIT)):
                body = self._read()
                for _ in range(self._skipped_at_most):
                    if not self._socket.poll(0):
                        break
                    body = self._read() or body
                if body:
                    self.received += 1
                    return body
            elif self._clock.now() >= deadline:
                raise TimeoutError(self._silence())

    def _read(self) -> bytes:
        """The JSON of the message that waits; empty for one of another kind."""
        message, *more = self._socket.recv_multipart()
        topic, _, body = message.partition(b" ")
        # The statistics of a run share the beginning of our topic.
        is_result = not more and body.startswith(b"{") and topic != STATISTICS
        return body if is_result else b""

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
        self._last_seq[sensor] = seq

    def __iter__(self) -> Iterator[Result]:
        while True:
            yield self.receive()
