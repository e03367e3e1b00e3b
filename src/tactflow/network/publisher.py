"""The socket that results are published on: by the sink `zmq`, and by the relay of several sensors."""

from __future__ import annotations

import zmq

from tactflow.network.bound_socket import BoundSocket, FloodError

SEND_BUFFER = 65_536
"""Kernel send buffer per subscriber unless it is said otherwise, bytes. One segment of the loopback device:
where the buffer holds none, longer messages wait for delayed acknowledgements. With 32 kB, depth maps of
480 kB at 30 Hz took 0.3 s each, and of the results beside them 43 % came (147 of 345; with 64 kB 350 of 350).
Larger ones hold more stale messages."""
MOST_SUBSCRIBED = 1 << 18
"""Bytes that all different subscriptions may have together, thousands of topics. ZeroMQ takes some 50 times
as much memory for them (600 MB for 12 MB, measured)."""
_READABLE = int(zmq.POLLIN)
"""As a plain number: an operation with one of `enum` takes 25 us in a run of 60 frames a second."""


class Publisher(BoundSocket):
    """An XPUB socket that is bound.

    endpoint, keys : as of `BoundSocket`. backlog : messages that may wait for each subscriber.
    send_buffer : of the kernel for each, bytes.
    """

    hint = (
        "another tactflow run, or another program, publishes there. End it, choose another address "
        "(--set sinks.zmq.endpoint=tcp://127.0.0.1:5557) or publish nothing (--set sinks.zmq=null)"
    )

    def __init__(self, endpoint: str, backlog: int, send_buffer: int, keys: str | None = None) -> None:
        self._subscribed = 0
        super().__init__(zmq.XPUB, endpoint, {zmq.SNDHWM: backlog, zmq.SNDBUF: send_buffer}, keys)

    def next_event(self) -> bytes | None:
        """The next subscription, 1 and the beginning of what is wanted, or its end, 0 and the same; or None.

        Never waits.

        Raises
        ------
        FloodError
            If all subscriptions together are too long, or connections take too many files: `renew` ends it.
        """
        self.refuse_crowd()
        if not int(self.socket.getsockopt(zmq.EVENTS)) & _READABLE:
            return None
        event = self.socket.recv(zmq.NOBLOCK)
        self._subscribed += (len(event) - 1) * (1 if event[:1] == b"\x01" else -1)
        if self._subscribed > MOST_SUBSCRIBED:
            raise FloodError("too many subscriptions")
        return event

    def renew(self) -> None:
        """As of `BoundSocket`; nobody has subscribed then."""
        self._subscribed = 0
        super().renew()
