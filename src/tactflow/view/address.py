"""Addresses of the live view; needs none of the view's packages."""

from __future__ import annotations

import errno
import socket
from collections.abc import Mapping
from pathlib import Path

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]"})
"""What a browser on this machine may call it."""

WILDCARDS = frozenset({"0.0.0.0", "::"})
"""Addresses that mean every interface of this machine."""


def bracketed(host: str) -> str:
    """A host as it stands in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def address(host: str, port: int) -> str:
    """The address of the page for people; a wildcard becomes the name of this machine."""
    return f"http://{socket.gethostname() if host in WILDCARDS else bracketed(host)}:{port}/"


def bind(host: str, port: int, *, tries: int = 20) -> socket.socket:
    """A listening socket on `port`, or, where that is taken, on the next free one.

    host : address or name of this machine. port : 0 means any. tries : so many ports are tried, then any.

    Raises
    ------
    OSError
        If the address is not of this machine, or the port is not allowed.
    """
    family, _, _, _, resolved = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    candidates = range(port, min(port + tries, 65536)) if port else range(0)
    for candidate in (*candidates, 0):
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            # A run that was just ended leaves its port in a state that would otherwise refuse the next one.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((resolved[0], candidate, *resolved[2:]))
            listener.listen(64)
        except OSError as error:
            listener.close()
            if candidate == 0 or error.errno != errno.EADDRINUSE:
                raise
        else:
            return listener
    raise AssertionError("port 0 either binds or raises")


class Neighbours:
    """How the views of a run of several sensors, one process each, find each other: a file each in a folder.

    folder : shared by them and by nobody else. sensor : whose view this is.
    """

    def __init__(self, folder: Path, sensor: str) -> None:
        self._folder = folder
        self._own = folder / f"{sensor}.view"

    def announce(self, port: int) -> None:
        """Tell the others where this view is."""
        draft = self._own.with_suffix(".draft")
        draft.write_text(str(port))
        draft.replace(self._own)

    def leave(self) -> None:
        """This view has ended."""
        self._own.unlink(missing_ok=True)

    def __call__(self) -> Mapping[str, int]:
        """Sensor -> port of every other view that is there now."""
        found: dict[str, int] = {}
        for file in sorted(self._folder.glob("*.view")):
            if file != self._own:
                try:
                    found[file.stem] = int(file.read_text())
                except (OSError, ValueError):
                    # It has ended in this moment.
                    continue
        return found
