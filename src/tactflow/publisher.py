"""The socket of whoever publishes over ZeroMQ: the sink `zmq`, and the relay of several sensors."""

from __future__ import annotations

import errno
import socket as system_socket
import sys
from pathlib import Path

import zmq

from tactflow.engine.errors import StageError

LONGEST_SUBSCRIPTION = 4096
"""Bytes of a subscription: topics have some twenty. ZeroMQ keeps subscriptions in a tree and takes a step on
the stack for each of their bytes: one of a megabyte ends the process."""


def bind_publisher(
    context: zmq.Context[zmq.Socket[bytes]], endpoint: str, backlog: int, send_buffer: int
) -> zmq.Socket[bytes]:
    """An XPUB socket that is bound.

    backlog : messages that may wait for each subscriber. send_buffer : of the kernel for each, bytes.

    Raises
    ------
    StageError : the address is taken, or cannot be bound. Nothing is left open.
    """
    _refuse_taken_path(endpoint)
    socket = context.socket(zmq.XPUB)
    socket.sndhwm = backlog
    socket.setsockopt(zmq.SNDBUF, send_buffer)
    socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_SUBSCRIPTION)
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        socket.close(linger=0)
        raise StageError(_bind_problem(endpoint, error)) from error
    return socket


def _refuse_taken_path(endpoint: str) -> None:
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
    raise StageError(_bind_problem(endpoint, zmq.ZMQError(errno.EADDRINUSE)))


def _bind_problem(endpoint: str, error: zmq.ZMQError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"{endpoint} is in use: another tactflow run, or another program, publishes there. End it, "
            "choose another address (--set sinks.zmq.endpoint=tcp://127.0.0.1:5557) or publish nothing "
            "(--set sinks.zmq=null)"
        )
    return (
        f"{endpoint} cannot be bound: {error.strerror}; required an address of this machine such as "
        "tcp://127.0.0.1:5556, tcp://*:5556 or ipc:///tmp/tactflow"
    )
