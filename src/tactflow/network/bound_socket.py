"""Sockets that others connect to over ZeroMQ: to read results, to send commands. They connect with
`connection.Connection`."""

from __future__ import annotations

import errno
import socket as system_socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import zmq

from tactflow.engine.errors import StageError
from tactflow.network.address import Address
from tactflow.network.keys import require_keys
from tactflow.system.files import expanded

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

LONGEST_REQUEST = 4096
"""Bytes of a subscription or a command, which have some twenty. ZeroMQ keeps subscriptions in a tree and
takes a step on the stack for each of their bytes: one of a megabyte ends the process."""
OPTIONS: dict[int, int] = {
    zmq.MAXMSGSIZE: LONGEST_REQUEST,
    # A connection that has not finished its handshake by then is closed, ms. Chosen by hand.
    zmq.HANDSHAKE_IVL: 5000,
    # After so much silence the system asks whether the other machine is still there, s. Chosen by hand.
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 10,
}


class BoundSocket:
    """A bound socket with a context, and with keys an authenticator, of its own.

    Parameters
    ----------
    kind : ZeroMQ's type of the socket. endpoint : address to bind.
    hint : what to try where the address is taken. options : ZeroMQ's option -> value.
    keys : the publisher's folder made by `tactflow keys new`: only those who have a key in it are admitted,
        and everything is encrypted. None admits everybody who can reach the address.

    Raises
    ------
    StageError : the address is invalid, taken or cannot be bound, or the keys are wrong. Nothing stays open.

    Attributes
    ----------
    socket : belongs to one thread at a time. endpoint : the real address, with the port that was picked.
    """

    def __init__(
        self, kind: int, endpoint: str, hint: str, options: Mapping[int, int], keys: str | None = None
    ) -> None:
        try:
            address = Address.parse(endpoint)
        except ValueError as error:
            raise StageError(str(error)) from None
        if address.host is None:
            _refuse_taken_path(Path(endpoint.removeprefix("ipc://")), endpoint, hint)
        self._authenticator: ThreadAuthenticator | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(kind)
        for option, value in {**OPTIONS, zmq.IPV6: address.is_ipv6, **options}.items():
            self.socket.setsockopt(option, value)
        try:
            if keys is not None:
                self._authenticator = require_keys(self.socket, self._context, expanded(keys))
            self.socket.bind(endpoint)
        except ValueError as error:
            self.close()
            raise StageError(f"keys: {error}") from error
        except zmq.ZMQError as error:
            self.close()
            is_taken = error.errno == errno.EADDRINUSE
            reason = f"is in use: {hint}" if is_taken else f"cannot be bound: {error.strerror}"
            raise StageError(f"{endpoint} {reason}") from error
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def close(self, linger: float = 0.0) -> None:
        """Deliver what is under way, for at most `linger` seconds, and free the address. May come twice."""
        if self._authenticator is not None:
            self._authenticator.stop()
            self._authenticator = None
        self.socket.close(linger=int(linger * 1000))
        self._context.term()


def _refuse_taken_path(path: Path, endpoint: str, hint: str) -> None:
    """ZeroMQ would delete whatever is at the path of an ipc address, even the socket of another run."""
    if sys.platform == "win32" or not path.exists():
        return
    if not path.is_socket():
        raise StageError(f"{endpoint}: {path} is a file; an address needs an unused path")
    with system_socket.socket(system_socket.AF_UNIX) as probe:
        # Nobody answers at a socket that a killed run has left behind.
        if probe.connect_ex(str(path)) == 0:
            raise StageError(f"{endpoint} is in use: {hint}")
