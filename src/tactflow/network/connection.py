"""The socket of whoever connects to a running tactflow: `Subscriber` and `RemoteControl`. Its counterpart is
`bound_socket.BoundSocket`."""

from __future__ import annotations

import math
import socket as system_socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zmq
from zmq.utils.monitor import recv_monitor_message

from tactflow.network.address import is_ipv6, refuse_high_port
from tactflow.network.keys import WrongKeysError, secure_subscriber
from tactflow.system.files import expanded

REFUSALS = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
"""After these, ZeroMQ does not try again."""
BROKEN_OFF = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
"""The other side has hung up before it said which keys it asks for, or was ended; ZeroMQ tries again."""


GREETING = b"\xff" + bytes(8) + b"\x7f\x03"
"""How a greeting of ZMTP 3 begins: signature and version (rfc.zeromq.org/spec/37)."""
MECHANISM = slice(12, 32)
"""Where the other side's greeting names what it asks for: NULL, or CURVE for keys."""
PATIENCE = 1.0
"""Time to connect and to be greeted at most, s. Chosen by hand."""


def asked_for(endpoint: str, seconds: float = PATIENCE) -> str | None:
    """What the side at an address asks for, NULL or CURVE; None if it does not greet as ZeroMQ does in time.

    ZeroMQ hangs up on who does not name the same, often before its own greeting is out, and then the socket
    cannot tell why. Who names nothing is greeted.

    seconds : for all of it, however many addresses a name has and however slowly the other side speaks.
    """
    end = time.monotonic() + seconds
    for family, address in _places(endpoint):
        with system_socket.socket(family) as stream:
            try:
                return _mechanism(stream, address, end)
            except OSError:
                continue
    return None


def _places(endpoint: str) -> list[tuple[int, Any]]:
    """Families and addresses of the sockets that an endpoint stands for; none if it is no such address."""
    scheme, _, place = endpoint.partition("://")
    if scheme == "ipc":
        if sys.platform == "win32":
            return []
        return [(system_socket.AF_UNIX, place)]
    host, _, port = place.rpartition(":")
    try:
        found = system_socket.getaddrinfo(host.strip("[]"), int(port), type=system_socket.SOCK_STREAM)
    except (OSError, ValueError):
        return []
    return [(family, address) for family, _, _, _, address in found]


def _mechanism(stream: system_socket.socket, address: Any, end: float) -> str | None:
    """As `asked_for`, of one address, until `end` (monotonic time). Raises OSError if nobody is there."""

    def in_time() -> system_socket.socket:
        left = end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        stream.settimeout(left)
        return stream

    in_time().connect(address)
    in_time().sendall(GREETING)
    greeting = b""
    while len(greeting) < MECHANISM.stop:
        received = in_time().recv(MECHANISM.stop - len(greeting))
        if not received:
            return None
        greeting += received
    return greeting[MECHANISM].rstrip(b"\0").decode("ascii", "replace")


class Connection:
    """A socket with a context of its own that notices when it is not admitted; a context manager.

    Parameters
    ----------
    kind : of the socket, as ZeroMQ counts them. endpoint : address to connect to.
    options : ZeroMQ's number of an option -> its value.
    keys : the subscriber's folder that `tactflow keys new` makes; None where there are none.
    example : an endpoint, for the error about one that is no address.

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
    ) -> None:
        refuse_high_port(endpoint)
        self.endpoint = endpoint
        self._is_refused = False
        self._has_keys = keys is not None
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(kind)
        self._socket.linger = 0
        self._socket.setsockopt(zmq.IPV6, is_ipv6(endpoint))
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
        while not self._is_refused:
            left = max(end - time.monotonic(), 0.0)
            ready = dict(self._poller.poll(math.ceil(left * 1000)))
            if self._refused not in ready:
                return bool(ready)
            broken_off = recv_monitor_message(self._refused)["event"] == BROKEN_OFF
            ours = "CURVE" if self._has_keys else "NULL"
            left = min(end - time.monotonic(), PATIENCE)
            self._is_refused = not broken_off or asked_for(self.endpoint, left) not in (ours, None)
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
