"""One address at which subscribers get the results of several sensors: a proxy of ZeroMQ."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

import zmq

from tactflow.network.parameters import PublisherParams
from tactflow.network.publisher import Publisher

QUIET_SECONDS = 0.1
"""Time at the end for messages that are still on their way between processes, s."""


@contextmanager
def relay(params: PublisherParams, upstream: Sequence[str]) -> Iterator[None]:
    """Bind an endpoint, and forward messages and subscriptions while the block lasts.

    params : of a sink that publishes there for all sensors. upstream : addresses of the publishers, which
    must have ended when the block ends; what they sent is still forwarded.

    Raises StageError if the address cannot be bound, or the keys are invalid.
    """
    publisher = Publisher(params.endpoint, params.backlog, params.keys)
    # A context of its own: the sensors of this run use no keys among themselves.
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    back = context.socket(zmq.XSUB)
    # As in the sink: a slow reader must not lag by seconds.
    back.rcvhwm = params.backlog
    # A full queue would lose subscriptions: a client may make thousands of them while a sensor is busy.
    back.sndhwm = 0
    for address in upstream:
        back.connect(address)
    thread = threading.Thread(
        target=_forward, args=(back, publisher.socket), name="tactflow-relay", daemon=True
    )
    thread.start()
    print(f"tactflow: publishing {len(upstream)} sensors on {params.endpoint}", file=sys.stderr)
    try:
        yield
    finally:
        time.sleep(QUIET_SECONDS)
        # Ends the proxy, which closes its socket.
        context.term()
        thread.join()
        publisher.close(params.linger)


def _forward(back: zmq.Socket[bytes], front: zmq.Socket[bytes]) -> None:
    """Body of the thread: messages go to the front, subscriptions to the back."""
    with back, suppress(zmq.ContextTerminated):
        back.linger = 0
        zmq.proxy(back, front)
