"""Who can reach an address."""

from __future__ import annotations

import ipaddress

LOOPBACK_INTERFACES = frozenset({"lo", "lo0"})
"""What Linux and macOS call the network that ends in this machine; an address may name it."""


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
