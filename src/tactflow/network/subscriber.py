"""A subscriber for programs that use what a running tactflow publishes.

Any ZeroMQ library in any language can do the same: a message is a topic, a space, and JSON.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import zmq

from tactflow.message.result import Result
from tactflow.network.connection import Connection

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5556"
"""Where tactflow publishes unless its pipeline says otherwise."""

LONGEST_WAIT = 1e6
"""Longest timeout, s (11 days): ZeroMQ counts milliseconds in 31 bits."""

OPTIONS: dict[int, int | bytes] = {
    # Back-off between attempts to reconnect, doubled from the first to the last, ms. Chosen by hand.
    zmq.RECONNECT_IVL: 50,
    zmq.RECONNECT_IVL_MAX: 250,
    # A publisher that has lost its power says no goodbye: ask it so often, ms. Chosen by hand.
    zmq.HEARTBEAT_IVL: 2000,
    zmq.HEARTBEAT_TIMEOUT: 6000,
}

BACKLOG = 10_000
"""Messages that may wait until they are read, nearly three minutes at 60 Hz and some 140 MB; what comes then
is lost, and counted. Chosen by hand."""

LONGEST_MESSAGE = 16 << 20
"""Longest message, bytes; one with 140 dots has about 14,000. The connection to a publisher that sends a
longer one is closed before memory is taken for it. Chosen by hand."""


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
    keys : the subscriber's folder that `tactflow keys new` makes, where the publisher asks for keys.

    Attributes
    ----------
    lost : frames missing between the results received so far, known from gaps in `seq`: those that tactflow
        dropped to stay live, those that did not fit a queue on the way, and with `latest` those skipped.
    received : messages received so far.
    malformed : of these, ones that were not result messages: another program publishes there.

    Raises
    ------
    ValueError : the endpoint is no address, the folder has no keys, or the timeout is out of range.

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
        keys: str | Path | None = None,
    ) -> None:
        if timeout is not None and not 0 <= timeout <= LONGEST_WAIT:
            raise ValueError(f"timeout: required None or 0 to {LONGEST_WAIT:g} seconds, got {timeout}")
        self.timeout = timeout
        self.lost = 0
        self.received = 0
        self.malformed = 0
        self._sensor = sensor
        self._last_seq: dict[str, int] = {}
        # Not zmq.CONFLATE, with which a message of several parts aborts the process.
        self._skipped_at_most = BACKLOG if latest else 0
        options: dict[int, int | bytes] = {
            **OPTIONS,
            zmq.RCVHWM: BACKLOG,
            zmq.MAXMSGSIZE: LONGEST_MESSAGE,
            # The space ends the topic: `main` must not receive `main2`.
            zmq.SUBSCRIBE: b"tactflow." if sensor is None else f"tactflow.{sensor} ".encode(),
        }
        super().__init__(zmq.SUB, endpoint, options, keys)

    def receive(self) -> Result:
        """Wait for the next result. Messages that are not results are passed over and counted.

        Raises
        ------
        TimeoutError : nothing came for `timeout` seconds.
        PermissionError : the publisher does not admit us: it asks for keys, or for others.
        """
        while True:
            try:
                result = Result.from_message(self.receive_json())
            except ValueError:
                self.malformed += 1
                continue
            # A smaller number than before means that tactflow was started again.
            expected = self._last_seq.get(result.sensor, result.seq) + 1
            self.lost += max(result.seq - expected, 0)
            self._last_seq[result.sensor] = result.seq
            return result

    def receive_json(self) -> bytes:
        """Wait for the next message: JSON in UTF-8; not counted in `lost`. Raises as `receive`."""
        deadline = math.inf if self.timeout is None else time.monotonic() + self.timeout
        while self._wait(deadline):
            body = self._read()
            for _ in range(self._skipped_at_most):
                if not self._socket.poll(0):
                    break
                body = self._read() or body
            if body:
                self.received += 1
                return body
        raise TimeoutError(self._silence())

    def _read(self) -> bytes:
        """The JSON of the message that waits; empty for one of another kind."""
        message, *more = self._socket.recv_multipart()
        topic, _, body = message.partition(b" ")
        # The statistics of a run share the beginning of our topic; no sensor may have their name.
        is_result = not more and body.startswith(b"{") and topic != b"tactflow.stats"
        return body if is_result else b""

    def _silence(self) -> str:
        what = f"no message from {self.endpoint} for {self.timeout:g} s"
        if self.received:
            return f"{what}; has the run ended?"
        name_hint = f", and is its sensor called {self._sensor}" if self._sensor else ""
        keys_hint = ", and are these keys for it" if self._has_keys else ""
        return f"{what}; is tactflow running and publishing there{name_hint}{keys_hint}?"

    def __iter__(self) -> Iterator[Result]:
        while True:
            yield self.receive()
