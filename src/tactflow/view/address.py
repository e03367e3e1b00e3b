"""Addresses of the live view, without imports of the server's packages."""

from __future__ import annotations

import errno
import socket
from collections.abc import Mapping
from pathlib import Path

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]"})
"""Host names under which a browser on this machine may open the page."""

WILDCARDS = frozenset({"0.0.0.0", "::"})
"""Addresses that stand for all interfaces of this machine."""


def bracketed(host: str) -> str:
    """Format a host for a URL: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def address(host: str, port: int) -> str:
    """URL of the page; a wildcard host becomes the name of this machine."""
    return f"http://{socket.gethostname() if host in WILDCARDS else bracketed(host)}:{port}/"


def bind(host: str, port: int, *, tries: int = 20) -> socket.socket:
    """Open a listening socket on `port`, or on the next free one.

    host : address or name of this machine. port : 0 for any. tries : number of ports tried before any free
    one.

    Raises
    ------
    OSError : the address does not belong to this machine, or the port is not permitted.
    """
    family, _, _, _, resolved = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    candidates = range(port, min(port + tries, 65536)) if port else range(0)
    two_families = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
    for candidate in candidates:
        try:
            return socket.create_server(
                (resolved[0], candidate, *resolved[2:]), family=family, dualstack_ipv6=two_families
            )
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    return socket.create_server((resolved[0], 0, *resolved[2:]), family=family, dualstack_ipv6=two_families)


class Neighbours:
    """Discovery between the views of several sensors (one process each), through files in a folder.

    Parameters
    ----------
    folder : shared by these views only.
    sensor : name of this view's sensor.
    """

    def __init__(self, folder: Path, sensor: str) -> None:
        self._folder = folder
        self._own = folder / f"{sensor}.view"

    def announce(self, port: int) -> None:
        """Publish the port of this view."""
        draft = self._own.with_suffix(".draft")
        draft.write_text(str(port))
        draft.replace(self._own)

    def leave(self) -> None:
        """Remove this view."""
        self._own.unlink(missing_ok=True)

    def __call__(self) -> Mapping[str, int]:
        """Sensor -> port of every other view."""
        ports: dict[str, int] = {}
        for file in sorted(self._folder.glob("*.view")):
            if file != self._own:
                try:
                    ports[file.stem] = int(file.read_text())
                except (OSError, ValueError):
                    # The view has just ended.
                    continue
        return ports
