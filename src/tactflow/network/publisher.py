"""The socket that results are published on: by the sink `zmq`, and by the relay of several sensors."""

from __future__ import annotations

import zmq

from tactflow.network.bound_socket import BoundSocket

SEND_BUFFER = 65_536
"""Kernel send buffer per subscriber unless the pipeline sets it, bytes. One segment of the loopback device:
longer messages than the buffer wait for delayed acknowledgements. With 32 kB, depth maps of 480 kB at 30 Hz
took 0.3 s each, and 43 % of the results beside them arrived (147 of 345; with 64 kB 350 of 350). Larger ones
hold more stale messages."""
_READABLE = int(zmq.POLLIN)
"""As a plain number: an operation with the `enum` takes 25 us."""
_HINT = (
    "another tactflow run, or another program, publishes there. End it, choose another address "
    "(--set sinks.zmq.endpoint=tcp://127.0.0.1:5557) or publish nothing (--set sinks.zmq=null)"
)


class Publisher(BoundSocket):
    """A bound XPUB socket.

    endpoint, keys : as for `BoundSocket`. backlog : messages that may wait for each subscriber.
    send_buffer : the kernel's, per subscriber, bytes.
    """

    def __init__(self, endpoint: str, backlog: int, send_buffer: int, keys: str | None = None) -> None:
        options: dict[int, int] = {zmq.SNDHWM: backlog, zmq.SNDBUF: send_buffer}
        super().__init__(zmq.XPUB, endpoint, _HINT, options, keys)

    def next_event(self) -> bytes | None:
        """The next subscription (1 and its prefix) or its end (0 and the prefix); None. Never waits."""
        if int(self.socket.getsockopt(zmq.EVENTS)) & _READABLE:
            return self.socket.recv(zmq.NOBLOCK)
        return None
