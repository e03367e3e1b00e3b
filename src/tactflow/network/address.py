"""What an address means, and who can reach it."""

from __future__ import annotations

import ipaddress
import re

LOOPBACK_INTERFACES = frozenset({"lo", "lo0"})
"""What Linux and macOS call the network that ends in this machine; an address may name it."""

HIGHEST_PORT = 65535
"""Ports are numbers of 16 bits."""


def refuse_high_port(endpoint: str) -> None:
    """Raise ValueError for a port that is none: ZeroMQ takes a larger number and means another port.

    >>> refuse_high_port("tcp://127.0.0.1:70000")
    Traceback (most recent call last):
    ValueError: required a port up to 65535, got 70000
    """
    port = re.fullmatch(r"tcp://.*:(\d+)", endpoint)
    if port is not None and int(port[1]) > HIGHEST_PORT:
        raise ValueError(f"required a port up to {HIGHEST_PORT}, got {port[1]}")


def is_loopback(host: str) -> bool:
    """Whether an address or name can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_reachable(endpoint: str) -> bool:
    """Whether other machines can reach an address.

    >>> is_reachable("tcp://*:5556"), is_reachable("tcp://127.0.0.1:5556"), is_reachable("ipc:///tmp/tactflow")
    (True, False, False)
    """
    scheme, _, place = endpoint.partition("://")
    if scheme in ("ipc", "inproc"):
        return False
    host = place.rpartition(":")[0].strip("[]")
    return not (scheme == "tcp" and (is_loopback(host) or host in LOOPBACK_INTERFACES))


def picks_a_port(endpoint: str) -> bool:
    """Whether an address leaves its port to the system.

    >>> picks_a_port("tcp://127.0.0.1:*"), picks_a_port("tcp://127.0.0.1:5556"), picks_a_port("ipc:///tmp/a")
    (True, False, False)
    """
    return endpoint.startswith("tcp://") and endpoint.endswith((":*", ":0"))


def is_ipv6(endpoint: str) -> bool:
    """Whether an address is one of IPv6, which ZeroMQ takes only where it is told to.

    >>> is_ipv6("tcp://[::1]:5556"), is_ipv6("tcp://127.0.0.1:5556"), is_ipv6("ipc:///tmp/a[1]")
    (True, False, False)
    """
    return endpoint.startswith("tcp://[")
