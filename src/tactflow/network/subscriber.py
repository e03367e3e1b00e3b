"""A subscriber to the results of a running tactflow.

Any ZeroMQ library in any language can do the same: a message is a topic, a space, and JSON.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from tactflow.message.result import Result
from tactflow.network.address import Address
from tactflow.network.keys import use_keys
from tactflow.system.files import expanded

log = logging.getLogger("tactflow")

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5556"
"""Default address of the sink `zmq`."""
MAX_TIMEOUT_S = 1e6
"""Longest timeout, s (11 days): ZeroMQ counts milliseconds in 31 bits."""
CLIENT_OPTIONS: dict[int, int | bytes] = {
    # Interval and timeout of heartbeats, to detect a publisher without power, ms. Chosen by hand.
    zmq.HEARTBEAT_IVL: 2000,
    zmq.HEARTBEAT_TIMEOUT: 6000,
}
MAX_QUEUED_MESSAGES = 10_000
"""Length of the receive queue, messages: nearly three minutes at 60 Hz, some 140 MB. Further ones are lost
and counted. Chosen by hand."""
REPORTED_DELAY_S = 1.0
"""Delay of a subscriber that is reported, s: a control loop would act on a contact long gone."""
REJECTION_EVENTS = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""The server rejected our keys; ZeroMQ does not retry."""
HANG_UP_EVENT = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
"""The server closed the connection during the handshake; ZeroMQ retries."""
MAX_HANG_UPS = 5
"""Consecutive hang-ups that count as a rejection; a server that ends causes one or two. Chosen by hand."""


class Connection:
    """A socket connected to a `BoundSocket`, which detects rejection; a context manager.

    Parameters
    ----------
    kind : ZeroMQ's type of the socket.
    endpoint : address to connect to.
    options : ZeroMQ's option -> value.
    keys : the subscriber's folder made by `tactflow keys new`; None if the run requires no keys.

    Raises
    ------
    ValueError : the endpoint is not an address, or the folder has no valid keys.
    """

    def __init__(
        self, kind: int, endpoint: str, options: Mapping[int, int | bytes], keys: str | Path | None
    ) -> None:
        address = Address.parse(endpoint)
        self.endpoint = endpoint
        self._has_keys = keys is not None
        self._hang_ups = 0
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(kind)
        self._handshakes = self._socket.get_monitor_socket(
            REJECTION_EVENTS | HANG_UP_EVENT | zmq.EVENT_HANDSHAKE_SUCCEEDED
        )
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._handshakes, zmq.POLLIN)
        try:
            for option, value in {zmq.IPV6: ":" in str(address.host), zmq.LINGER: 0, **options}.items():
                self._socket.setsockopt(option, value)
            if keys is not None:
                use_keys(self._socket, expanded(str(keys)))
            self._socket.connect(endpoint)
        except (ValueError, zmq.ZMQError) as error:
            self.close()
            if isinstance(error, zmq.ZMQError):
                raise ValueError(f"cannot connect to {endpoint!r}: {error.strerror}") from None
            raise

    def _wait(self, until: float) -> bool:
        """Wait for a message until a time of `time.monotonic`; False on timeout.

        Raises PermissionError if the server rejects us.
        """
        while self._hang_ups < MAX_HANG_UPS:
            seconds = max(until - time.monotonic(), 0.0)
            ready = dict(self._poller.poll(None if math.isinf(seconds) else math.ceil(seconds * 1000)))
            if self._handshakes not in ready:
                return bool(ready)
            event = recv_monitor_message(self._handshakes)["event"]
            if event & REJECTION_EVENTS:
                self._hang_ups = MAX_HANG_UPS
            else:
                self._hang_ups = self._hang_ups + 1 if event == HANG_UP_EVENT else 0
        reason = (
            "does not admit these keys, or requires none"
            if self._has_keys
            else "requires keys (tactflow keys new makes them), or is not tactflow"
        )
        raise PermissionError(f"{self.endpoint} {reason}")

    def close(self) -> None:
        """Disconnect. Idempotent."""
        if not self._socket.closed:
            self._socket.disable_monitor()
        self._handshakes.close(0)
        self._socket.close()
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Subscriber(Connection):
    """Receives results from a running tactflow; a context manager and an iterator of `Result`.

    Use it in one thread at a time. Connecting does not wait: tactflow may start before or after. A received
    result has the content of its message, `result.to_dict()`: no pictures, masks or height maps.

    Parameters
    ----------
    endpoint : address that tactflow publishes on.
    sensor : receive only this sensor; None for all.
    latest : skip to the newest queued message, for control loops. Otherwise messages are received in order.
    timeout : longest time without a message before a TimeoutError, s, 1e6 at most; None waits forever.
    keys : the subscriber's folder made by `tactflow keys new`, if the publisher requires keys.

    Attributes
    ----------
    lost : missing frames so far, from gaps in `seq`: dropped by tactflow to stay live, dropped by a full
        queue on the way, or skipped by `latest`.
    received : messages received so far.
    malformed : received messages that were not result messages, from another program.

    Raises
    ------
    ValueError : the endpoint is not an address, the folder has no keys, or the timeout is out of range.

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
        if timeout is not None and not 0 <= timeout <= MAX_TIMEOUT_S:
            raise ValueError(f"timeout: required None or 0 to {MAX_TIMEOUT_S:g} seconds, got {timeout}")
        self.timeout = timeout
        self.lost = 0
        self.received = 0
        self.malformed = 0
        self._sensor = sensor
        self._last_seq: dict[str, int] = {}
        self._is_latest = latest
        self._was_queued = False
        self._was_behind = False
        self._current_age: dict[str, float] = {}
        # With zmq.CONFLATE, a multipart message would abort the process.
        self._skipped_at_most = MAX_QUEUED_MESSAGES if latest else 0
        options: dict[int, int | bytes] = {
            **CLIENT_OPTIONS,
            zmq.RCVHWM: MAX_QUEUED_MESSAGES,
            # The space ends the topic: `main` must not match `main2`.
            zmq.SUBSCRIBE: b"tactflow." if sensor is None else f"tactflow.{sensor} ".encode(),
        }
        super().__init__(zmq.SUB, endpoint, options, keys)

    def receive(self) -> Result:
        """Wait for the next result. Other messages are ignored and counted.

        Raises
        ------
        TimeoutError : no message for `timeout` seconds.
        PermissionError : the publisher rejects our keys, or requires some.
        """
        while True:
            try:
                result = Result.from_message(self.receive_json())
            except ValueError:
                self.malformed += 1
                continue
            self._watch_delay(result)
            # A smaller number than before means that tactflow was restarted.
            expected = self._last_seq.get(result.sensor, result.seq) + 1
            self.lost += max(result.seq - expected, 0)
            self._last_seq[result.sensor] = result.seq
            return result

    def receive_json(self) -> bytes:
        """Wait for the next message, JSON in UTF-8; not counted in `lost`. Raises as `receive`."""
        deadline = math.inf if self.timeout is None else time.monotonic() + self.timeout
        self._was_queued = bool(self._socket.poll(0))
        while self._wait(deadline):
            body = self._read()
            for _ in range(self._skipped_at_most):
                if not self._socket.poll(0):
                    break
                body = self._read() or body
            if body:
                self.received += 1
                return body
        raise TimeoutError(self._timeout_message())

    def _watch_delay(self, result: Result) -> None:
        """Warn once if queued messages are older by `REPORTED_DELAY_S` than the last one that we waited for.

        This compares neither the clocks of two machines nor the time of a recording with ours.
        """
        age = time.monotonic() - result.t
        current = self._current_age.setdefault(result.sensor, age)
        has_restarted = result.seq <= self._last_seq.get(result.sensor, -1)
        if not self._was_queued or has_restarted or age < current:
            self._current_age[result.sensor] = age
        elif age - current >= REPORTED_DELAY_S and not (self._is_latest or self._was_behind):
            self._was_behind = True
            log.warning(
                "Subscriber: reads more slowly than tactflow publishes, and is %.1f s behind; "
                "Subscriber(..., latest=True) skips to the newest result",
                age - current,
            )

    def _read(self) -> bytes:
        """The JSON of the next queued message; empty for one of another kind."""
        message, *more = self._socket.recv_multipart()
        topic, _, body = message.partition(b" ")
        # The topic of statistics has the same prefix; no sensor may have its name.
        is_result = not more and body.startswith(b"{") and topic != b"tactflow.stats"
        return body if is_result else b""

    def _timeout_message(self) -> str:
        problem = f"no message from {self.endpoint} for {self.timeout:g} s"
        if self.received:
            return f"{problem}; has the run ended?"
        name_hint = f", and is its sensor called {self._sensor}" if self._sensor else ""
        keys_hint = ", and are these keys for it" if self._has_keys else ""
        return f"{problem}; is tactflow running and publishing there{name_hint}{keys_hint}?"

    def __iter__(self) -> Iterator[Result]:
        while True:
            yield self.receive()
