"""One address for subscribers of several sensors."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zmq

from tactflow.engine.errors import StageError
from tactflow.publisher import bind_publisher

SEND_BUFFER = 32_768
"""Kernel send buffer per subscriber, bytes, the ZeroMQ sink's default. Large ones hold seconds of messages.
Chosen by hand."""
LINGER_MS = 500
"""Time to deliver the last messages at the end, ms. Chosen by hand."""
POLL_MS = 100
"""How often the thread looks whether it shall end, ms. Chosen by hand."""


@contextmanager
def relay(address: str, upstream: Sequence[str], backlog: int) -> Iterator[None]:
    """Bind `address` and pass on what the upstream publishers send, while the block lasts.

    upstream : addresses of the publishers. backlog : messages that may wait for each subscriber.

    Raises
    ------
    StageError : the address cannot be bound.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        front = bind_publisher(context, address, backlog, SEND_BUFFER)
    except StageError:
        context.term()
        raise
    back = context.socket(zmq.XSUB)
    front.linger = LINGER_MS
    back.linger = 0
    # As in the sink: a slow reader shall not be seconds behind.
    back.rcvhwm = backlog
    for publisher in upstream:
        back.connect(publisher)
    stop = threading.Event()
    thread = threading.Thread(target=_pass_on, args=(front, back, stop), name="tactflow-relay", daemon=True)
    thread.start()

    print(f"tactflow: publishing {len(upstream)} sensors on {address}", file=sys.stderr)
    try:
        yield
    finally:
        stop.set()
        thread.join(5)
        front.close()
        back.close()
        context.term()


def _pass_on(front: zmq.Socket[bytes], back: zmq.Socket[bytes], stop: threading.Event) -> None:
    """Body of the relay's thread: messages to the front, subscriptions to the back, until told to stop."""
    poller = zmq.Poller()
    poller.register(front, zmq.POLLIN)
    poller.register(back, zmq.POLLIN)
    while True:
        events = dict(poller.poll(POLL_MS))
        if front in events:
            back.send(front.recv())
        if back in events:
            front.send(back.recv())
        elif stop.is_set():
            return
