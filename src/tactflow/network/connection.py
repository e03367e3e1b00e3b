"""The client side of a `bound_socket.BoundSocket`: base of `Subscriber` and `RemoteControl`."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from tactflow.network.address import Address
from tactflow.network.keys import use_keys
from tactflow.system.files import expanded

REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""The server rejected our keys; ZeroMQ does not retry."""
HUNG_UP = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
"""The server closed the connection during the handshake; ZeroMQ retries."""
MOST_HANG_UPS = 5
"""Consecutive hang-ups that count as a rejection; a server that ends causes one or two. Chosen by hand."""


class Connection:
    """A connected socket with its own context that detects rejection; a context manager.

    kind : ZeroMQ's type of the socket. endpoint : address to connect to. options : ZeroMQ's option -> value.
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
        for option, value in {zmq.LINGER: 0, zmq.IPV6: address.is_ipv6, **options}.items():
            self._socket.setsockopt(option, value)
        self._handshakes = self._socket.get_monitor_socket(REFUSED | HUNG_UP | zmq.EVENT_HANDSHAKE_SUCCEEDED)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._handshakes, zmq.POLLIN)
        try:
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
        while self._hang_ups < MOST_HANG_UPS:
            seconds = max(until - time.monotonic(), 0.0)
            ready = dict(self._poller.poll(None if math.isinf(seconds) else math.ceil(seconds * 1000)))
            if self._handshakes not in ready:
                return bool(ready)
            event = recv_monitor_message(self._handshakes)["event"]
            if event & REFUSED:
                self._hang_ups = MOST_HANG_UPS
            else:
                self._hang_ups = self._hang_ups + 1 if event == HUNG_UP else 0
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
