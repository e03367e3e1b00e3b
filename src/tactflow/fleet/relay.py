"""One address for subscribers of several sensors."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zmq

from tactflow.publisher import Publisher

SEND_BUFFER = 32_768
"""Kernel send buffer per subscriber, bytes, the ZeroMQ sink's default. Large ones hold seconds of messages.
Chosen by hand."""
LINGER = 0.5
"""Time to deliver the last messages at the end, s. Chosen by hand."""
POLL_MS = 100
"""How often the thread looks whether it shall end, ms. Chosen by hand."""


@contextmanager
def relay(address: str, upstream: Sequence[str], backlog: int, keys: str | None = None) -> Iterator[None]:
    """Bind `address` and pass on what the upstream publishers send, while the block lasts.

    upstream : addresses of the publishers. backlog : messages that may wait for each subscriber.
    keys : as of `Publisher`.

    Raises
    ------
    StageError : the address cannot be bound, or the keys are wrong.
    """
    publisher = Publisher(address, backlog, SEND_BUFFER, keys)
    front = publisher.socket
    # A context of its own: nobody asks the sensors of this run for keys.
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    back = context.socket(zmq.XSUB)
    back.linger = 0
    # As in the sink: a slow reader shall not be seconds behind.
    back.rcvhwm = backlog
    for source in upstream:
        back.connect(source)
    stop = threading.Event()
    thread = threading.Thread(target=_pass_on, args=(front, back, stop), name="tactflow-relay", daemon=True)
    thread.start()

    print(f"tactflow: publishing {len(upstream)} sensors on {address}", file=sys.stderr)
    try:
        yield
    finally:
        stop.set()
        thread.join(5)
        publisher.close(LINGER)
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
