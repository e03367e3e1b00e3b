"""A socket that others connect to over ZeroMQ: to read results (`publisher.py`), to send commands
(`control_socket.py`). Its counterpart is `connection.py`."""

from __future__ import annotations

import errno
import socket as system_socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import zmq

from tactflow.engine.errors import StageError
from tactflow.network.address import is_ipv6
from tactflow.network.keys import DOMAIN, WrongKeysError, secure_publisher, subscribers_folder
from tactflow.system.files import expanded, files_left

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

LONGEST_REQUEST = 4096
"""Bytes of a subscription or a command, which have some twenty. ZeroMQ keeps subscriptions in a tree and
takes a step on the stack for each of their bytes: one of a megabyte ends the process."""
HANDSHAKE_MS = 5000
"""A connection that has not said by then that it is a subscriber ends, ms. Chosen by hand."""
KEEPALIVE_S = 10
"""After so much silence the system asks whether a subscriber's machine is still there, s. Chosen by hand."""
FEWEST_FILES = 64
"""Files that a run must still be able to open; each connection takes one. Chosen by hand."""
FILES_EVERY = 0.2
"""Time between two looks at how many there are, s. Chosen by hand."""


class FloodError(Exception):
    """Those who connect have taken more than they may; says what."""


class BoundSocket:
    """A socket that is bound, with a context and an authenticator of its own.

    Parameters
    ----------
    kind : of the socket, as ZeroMQ counts them. endpoint : address to bind.
    options : ZeroMQ's number of an option -> its value.
    keys : the publisher's folder as `tactflow keys new` makes it: only who has a key there is admitted, and
        all is encrypted. None admits everybody who can reach the address.

    Raises
    ------
    StageError
        If the address is taken or cannot be bound, or the keys are wrong. Nothing is left open.

    Attributes
    ----------
    socket : belongs to one thread at a time.
    endpoint : the real address, where a port was to be chosen.
    """

    hint = ""
    """What to try where the address is taken."""

    def __init__(self, kind: int, endpoint: str, options: Mapping[int, int], keys: str | None = None) -> None:
        _refuse_taken_path(endpoint, self.hint)
        self._kind = kind
        self._options = dict(options)
        self._keys = keys
        self._open(endpoint)
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def _open(self, endpoint: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._look_at_files = 0.0
        self.socket = socket = self._context.socket(self._kind)
        socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_REQUEST)
        socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        socket.setsockopt(zmq.IPV6, is_ipv6(endpoint))
        socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
        socket.setsockopt(zmq.TCP_KEEPALIVE_IDLE, KEEPALIVE_S)
        for option, value in self._options.items():
            socket.setsockopt(option, value)
        try:
            if self._keys is not None:
                self._ask_for_keys(expanded(self._keys))
            socket.bind(endpoint)
        except WrongKeysError as error:
            self.close(0)
            raise StageError(f"keys: {error}") from error
        except zmq.ZMQError as error:
            self.close(0)
            raise StageError(_bind_problem(endpoint, error, self.hint)) from error

    def _ask_for_keys(self, folder: Path) -> None:
        secure_publisher(self.socket, folder)
        allowed = subscribers_folder(folder)
        # It imports asyncio, a tenth of what a run takes to start.
        from zmq.auth.thread import ThreadAuthenticator

        self._authenticator = ThreadAuthenticator(self._context)
        self._authenticator.start()
        self._authenticator.configure_curve(domain=DOMAIN, location=allowed)

    def refuse_crowd(self) -> None:
        """Look, not too often, whether connections leave enough files to the run.

        Raises
        ------
        FloodError
            If they do not: `renew` ends it.
        """
        now = time.monotonic()
        if now > self._look_at_files:
            self._look_at_files = now + FILES_EVERY
            if files_left() < FEWEST_FILES:
                raise FloodError("too many connections")

    def renew(self) -> None:
        """Disconnect everybody, who may come again, and give back what they took.

        Raises
        ------
        StageError
            If another program has taken the address in this moment.
        """
        self.close(0)
        self._open(self.endpoint)

    def close(self, linger: float) -> None:
        """Deliver what is under way, for at most `linger` seconds, and free the address. May come twice."""
        if self._authenticator is not None:
            self._authenticator.stop()
            self._authenticator = None
        self.socket.close(linger=int(linger * 1000))
        self._context.term()


def _refuse_taken_path(endpoint: str, hint: str) -> None:
    """ZeroMQ deletes whatever stands at the path of an ipc address, even one that somebody listens at."""
    path = Path(endpoint.removeprefix("ipc://"))
    if sys.platform == "win32" or not endpoint.startswith("ipc://") or not path.exists():
        return
    if not path.is_socket():
        raise StageError(f"{endpoint}: {path} is a file; an address needs a path where nothing is yet")
    with system_socket.socket(system_socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            # Left behind by a run that was killed.
            return
    raise StageError(_bind_problem(endpoint, zmq.ZMQError(errno.EADDRINUSE), hint))


def _bind_problem(endpoint: str, error: zmq.ZMQError, hint: str) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"{endpoint} is in use: {hint}"
    return (
        f"{endpoint} cannot be bound: {error.strerror}; required an address of this machine such as "
        "tcp://127.0.0.1:5556, tcp://*:5556 or ipc:///tmp/tactflow"
    )
