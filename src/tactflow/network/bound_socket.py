"""ZeroMQ sockets of a run: for results, and for commands. Clients connect with `connection.Connection`."""

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
"""Largest subscription or command, bytes; usual ones have some twenty. ZeroMQ keeps subscriptions in a tree
and recurses once per byte: a subscription of a megabyte overflows the stack."""
OPTIONS: dict[int, int] = {
    zmq.MAXMSGSIZE: LONGEST_REQUEST,
    # Handshake timeout, ms. Chosen by hand.
    zmq.HANDSHAKE_IVL: 5000,
    # Idle time before the first keep-alive probe, s. Chosen by hand.
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 10,
}


class BoundSocket:
    """A bound socket with its own context and, if keys are required, its own authenticator.

    Parameters
    ----------
    kind : ZeroMQ's type of the socket. endpoint : address to bind.
    hint : advice if the address is in use. options : ZeroMQ's option -> value.
    keys : the publisher's folder made by `tactflow keys new`: only clients with a key in it are admitted, and
        everything is encrypted. None admits every client that can reach the address.

    Raises
    ------
    StageError : the address is invalid, in use or cannot be bound, or the keys are wrong.

    Attributes
    ----------
    socket : to be used by one thread at a time. endpoint : the bound address, with the actual port.
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
        """Deliver pending messages for at most `linger` seconds, then free the address. Idempotent."""
        if self._authenticator is not None:
            self._authenticator.stop()
            self._authenticator = None
        self.socket.close(linger=int(linger * 1000))
        self._context.term()


def _refuse_taken_path(path: Path, endpoint: str, hint: str) -> None:
    """Refuse the path of a file or of another run's socket: ZeroMQ would delete it."""
    if sys.platform == "win32" or not path.exists():
        return
    if not path.is_socket():
        raise StageError(f"{endpoint}: {path} is a file; an address needs an unused path")
    with system_socket.socket(system_socket.AF_UNIX) as probe:
        # A socket left behind by a killed run refuses the connection, and may be replaced.
        if probe.connect_ex(str(path)) == 0:
            raise StageError(f"{endpoint} is in use: {hint}")
