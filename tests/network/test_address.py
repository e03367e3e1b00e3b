"""Addresses: which ones are valid, and which only this machine can reach."""

from __future__ import annotations

import pytest

from tactflow.network.address import Address


@pytest.mark.parametrize(
    ("text", "is_local", "picks_a_port"),
    [
        ("tcp://127.0.0.1:5556", True, False),
        ("tcp://localhost:*", True, True),
        ("tcp://lo:0", True, True),
        ("tcp://[::1]:5556", True, False),
        ("ipc:///tmp/tactflow", True, False),
        ("tcp://*:5556", False, False),
        ("tcp://0.0.0.0:5556", False, False),
        ("tcp://[::]:1", False, False),
        ("tcp://eth0:*", False, True),
        ("tcp://robot.example:5556", False, False),
    ],
)
def test_an_address_says_who_reaches_it_and_whether_the_system_picks_its_port(
    text: str, is_local: bool, picks_a_port: bool
) -> None:
    address = Address.parse(text)
    assert (address.text, address.is_local, address.picks_a_port) == (text, is_local, picks_a_port)


@pytest.mark.parametrize(
    "text", ["", "5556", "foo://bar", "inproc://a", "ipc://", "tcp://127.0.0.1", "tcp://:1"]
)
def test_anything_else_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="required an address such as tcp://127"):
        Address.parse(text)
