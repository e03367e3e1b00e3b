"""One address for subscribers of several sensors."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zmq

from tactflow.engine.errors import StageError
from tactflow.network.bound_socket import FloodError
from tactflow.network.publisher import SEND_BUFFER, Publisher

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
    stop = threading.Event()
    work = _Relay(publisher, upstream, backlog, stop)
    thread = threading.Thread(target=work.run, name="tactflow-relay", daemon=True)
    thread.start()

    print(f"tactflow: publishing {len(upstream)} sensors on {address}", file=sys.stderr)
    try:
        yield
    finally:
        stop.set()
        thread.join(5)
        publisher.close(LINGER)


class _Relay:
    """Messages to the front, subscriptions to the back, until told to stop; all of it in one thread."""

    def __init__(
        self, publisher: Publisher, upstream: Sequence[str], backlog: int, stop: threading.Event
    ) -> None:
        self._publisher = publisher
        self._upstream = upstream
        self._backlog = backlog
        self._stop = stop

    def run(self) -> None:
        """Body of the thread."""
        # A context of its own: nobody asks the sensors of this run for keys.
        with zmq.Context() as context:
            flooded = True
            while flooded:
                with context.socket(zmq.XSUB) as back:
                    back.linger = 0
                    # As in the sink: a slow reader shall not be seconds behind.
                    back.rcvhwm = self._backlog
                    for source in self._upstream:
                        back.connect(source)
                    flooded = self._pass_on(back)

    def _pass_on(self, back: zmq.Socket[bytes]) -> bool:
        """Until told to stop; True: until subscribers took too much and were disconnected."""
        front = self._publisher.socket
        poller = zmq.Poller()
        poller.register(front, zmq.POLLIN)
        poller.register(back, zmq.POLLIN)
        while True:
            events = dict(poller.poll(POLL_MS))
            try:
                event = self._publisher.next_event()
            except FloodError as error:
                print(f"tactflow: {error}; all subscribers are disconnected", file=sys.stderr)
                try:
                    self._publisher.renew()
                except StageError as failure:
                    print(f"tactflow: nothing is published any more: {failure}", file=sys.stderr)
                    return False
                return True
            if event is not None:
                back.send(event)
            if back in events:
                front.send(back.recv())
            elif self._stop.is_set():
                return False
