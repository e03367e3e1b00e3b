"""Addresses of the live view; needs none of the view's packages."""

from __future__ import annotations

import errno
import ipaddress
import socket

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]"})
"""What a browser on this machine may call it."""

WILDCARDS = frozenset({"0.0.0.0", "::"})
"""Addresses that mean every interface of this machine."""


def is_loopback(host: str) -> bool:
    """Whether an address or name can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


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
