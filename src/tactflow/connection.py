"""The socket of whoever connects to a running tactflow: `Subscriber` and `RemoteControl`. Its counterpart is
`publisher.BoundSocket`."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from tactflow.files import expanded
from tactflow.keys import WrongKeysError, secure_subscriber

REFUSALS = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""After these, ZeroMQ does not try again."""
BROKEN_OFF = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
"""The other side has hung up before it said which keys it asks for, or was ended; ZeroMQ tries again."""


class Connection:
    """A socket with a context of its own that notices when it is not admitted; a context manager.

    Parameters
    ----------
    kind : of the socket, as ZeroMQ counts them. endpoint : address to connect to.
    options : ZeroMQ's number of an option -> its value.
    keys : the subscriber's folder that `tactflow keys new` makes; None where there are none.
    example : an endpoint, for the error about one that is no address.
    tries : handshakes that may be broken off before this counts as a refusal. A side that asks for keys may
        break off before it has said so, every time; so may what stands for a run that is not there yet.

    Raises
    ------
    ValueError
        If the endpoint is no address, or the folder has no keys.
    """

    def __init__(
        self,
        kind: int,
        endpoint: str,
        options: Mapping[int, int | bytes],
        keys: str | Path | None,
        example: str,
        tries: float = math.inf,
    ) -> None:
        self.endpoint = endpoint
        self._tries = tries
        self._has_keys = keys is not None
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(kind)
        self._socket.linger = 0
        for option, value in options.items():
            self._socket.setsockopt(option, value)
        self._refused = self._socket.get_monitor_socket(REFUSALS | BROKEN_OFF)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._refused, zmq.POLLIN)
        try:
            if keys is not None:
                secure_subscriber(self._socket, expanded(str(keys)))
            self._socket.connect(endpoint)
        except WrongKeysError:
            self.close()
            raise
        except zmq.ZMQError as error:
            self.close()
            raise ValueError(
                f"required an address such as {example}, got {endpoint!r}: {error.strerror}"
            ) from None

    def _wait(self, seconds: float) -> bool:
        """Wait until a message can be received; False if none came in time.

        Raises
        ------
        PermissionError
            If the other side does not admit us.
        """
        end = time.monotonic() + seconds
        while self._tries > 0:
            left = max(end - time.monotonic(), 0.0)
            ready = dict(self._poller.poll(math.ceil(left * 1000)))
            if self._refused not in ready:
                return bool(ready)
            broken_off = recv_monitor_message(self._refused)["event"] == BROKEN_OFF
            self._tries = self._tries - 1 if broken_off else 0
        why = (
            "does not admit these keys"
            if self._has_keys
            else "asks for keys, which tactflow keys new makes, or is no tactflow"
        )
        raise PermissionError(f"{self.endpoint} {why}")

    def close(self) -> None:
        """Disconnect. May be called twice."""
        if not self._socket.closed:
            self._socket.disable_monitor()
        self._refused.close(0)
        self._socket.close()
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
