"""Addresses of ZeroMQ sockets."""

from __future__ import annotations

import ipaddress
import re
from typing import NamedTuple


class Address(NamedTuple):
    """`tcp://HOST:PORT` or `ipc://PATH`.

    Attributes
    ----------
    host : name, number or `*` (all interfaces); None for ipc.
    port : None where the system picks one (`*`, 0) and for ipc.

    Examples
    --------
    >>> Address.parse("tcp://127.0.0.1:*")
    Address(text='tcp://127.0.0.1:*', host='127.0.0.1', port=None)
    """

    text: str
    host: str | None
    port: int | None

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse an address; raises ValueError with what is required.

        >>> Address.parse("tcp://127.0.0.1:70000")
        Traceback (most recent call last):
        ValueError: required a port up to 65535, got 70000
        """
        if re.fullmatch("ipc://.+", text):
            return cls(text, None, None)
        tcp = re.fullmatch(r"tcp://(.+):(\d+|\*)", text)
        if tcp is None:
            example = "tcp://127.0.0.1:5556, tcp://*:5556 or ipc:///tmp/tactflow"
            raise ValueError(f"required an address such as {example}, got {text!r}")
        port = 0 if tcp[2] == "*" else int(tcp[2])
        # ZeroMQ would take it modulo 65536.
        if port > 65535:
            raise ValueError(f"required a port up to 65535, got {port}")
        return cls(text, tcp[1].strip("[]"), port or None)

    @property
    def is_local(self) -> bool:
        """Whether only this machine can reach it."""
        # lo, lo0 : the loopback interface on Linux and macOS.
        return self.host in (None, "lo", "lo0") or is_loopback(str(self.host))

    @property
    def picks_a_port(self) -> bool:
        """Whether the system picks the port."""
        return self.host is not None and self.port is None


def is_loopback(host: str) -> bool:
    """Whether a host name or number can be reached from this machine only."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
