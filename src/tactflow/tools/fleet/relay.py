"""One address at which subscribers get the results of several sensors."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zmq

from tactflow.engine.contract import Publication
from tactflow.network.publisher import Publisher

POLL_MS = 100
"""Poll interval of the relay's thread, ms; also how long the upstream must be quiet before the relay ends."""
LONGEST_END = 5.0
"""Time limit for the thread to end, beyond the time that its last messages may linger, s."""


@contextmanager
def relay(publication: Publication, upstream: Sequence[str]) -> Iterator[None]:
    """Bind the address of a publication, and forward messages and subscriptions while the block lasts.

    upstream : addresses of the publishers, which must have ended when the block ends; what they sent is still
    forwarded. Raises StageError if the address cannot be bound, or the keys are invalid.
    """
    publisher = Publisher(publication.address, publication.backlog, publication.keys)
    stop = threading.Event()
    arguments = (publisher, upstream, publication.backlog, stop)
    thread = threading.Thread(target=_forward, args=arguments, name="tactflow-relay", daemon=True)
    thread.start()
    print(f"tactflow: publishing {len(upstream)} sensors on {publication.address}", file=sys.stderr)
    try:
        yield
    finally:
        stop.set()
        thread.join(publication.linger + LONGEST_END)
        publisher.close(publication.linger)


def _forward(publisher: Publisher, upstream: Sequence[str], backlog: int, stop: threading.Event) -> None:
    """Forward messages downstream and subscriptions upstream until stopped and the upstream is quiet."""
    # A context of its own: the sensors of this run use no keys among themselves.
    with zmq.Context() as context, context.socket(zmq.XSUB) as back:
        back.linger = 0
        # As in the sink: a slow reader must not lag by seconds.
        back.rcvhwm = backlog
        # A full queue would lose subscriptions: a client may make thousands of them while a sensor is busy.
        back.sndhwm = 0
        for source in upstream:
            back.connect(source)
        poller = zmq.Poller()
        poller.register(publisher.socket, zmq.POLLIN)
        poller.register(back, zmq.POLLIN)
        while True:
            stopping = stop.is_set()
            ready = dict(poller.poll(POLL_MS))
            subscription = publisher.next_event()
            if subscription is not None:
                back.send(subscription)
            if back in ready:
                publisher.socket.send(back.recv())
            elif stopping:
                return
