"""One address for subscribers of several sensors."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zmq

from tactflow.network.publisher import SEND_BUFFER, Publisher

POLL_MS = 100
"""How often the thread looks whether it shall end, ms. Chosen by hand."""
LONGEST_END = 5.0
"""Time that the thread gets to end, once it need not linger, s. Chosen by hand."""
COMES_OR_GOES = zmq.EVENT_CONNECTED | zmq.EVENT_DISCONNECTED
"""What is told about the connections to the publishers."""


@contextmanager
def relay(
    address: str, upstream: Sequence[str], backlog: int, linger: float, keys: str | None = None
) -> Iterator[None]:
    """Bind `address` and pass on what the upstream publishers send, while the block lasts.

    upstream : addresses of the publishers. backlog : messages that may wait for each subscriber.
    linger : time to deliver the last ones at the end, s. keys : as of `Publisher`.

    Raises
    ------
    StageError : the address cannot be bound, or the keys are wrong.
    """
    publisher = Publisher(address, backlog, SEND_BUFFER, keys)
    stop = threading.Event()
    work = _Relay(publisher, upstream, backlog, linger, stop)
    thread = threading.Thread(target=work.run, name="tactflow-relay", daemon=True)
    thread.start()

    print(f"tactflow: publishing {len(upstream)} sensors on {address}", file=sys.stderr)
    try:
        yield
    finally:
        stop.set()
        thread.join(linger + LONGEST_END)
        publisher.close(linger)


class _Relay:
    """Messages to the front, subscriptions to the back, until told to stop; all of it in one thread.

    After that until the publishers are gone, whose last messages may be on the way, for at most `linger`.
    """

    def __init__(
        self,
        publisher: Publisher,
        upstream: Sequence[str],
        backlog: int,
        linger: float,
        stop: threading.Event,
    ) -> None:
        self._publisher = publisher
        self._upstream = upstream
        self._backlog = backlog
        self._linger = linger
        self._stop = stop

    def run(self) -> None:
        """Body of the thread."""
        # A context of its own: nobody asks the sensors of this run for keys.
        with zmq.Context() as context, context.socket(zmq.XSUB) as back:
            back.linger = 0
            # As in the sink: a slow reader shall not be seconds behind.
            back.rcvhwm = self._backlog
            with back.get_monitor_socket(COMES_OR_GOES) as connections:
                for source in self._upstream:
                    back.connect(source)
                self._pass_on(back, connections)
                back.disable_monitor()

    def _pass_on(self, back: zmq.Socket[bytes], connections: zmq.Socket[bytes]) -> None:
        """Until told to stop."""
        # Imported here: it imports asyncio, which the run of one sensor does without.
        from zmq.utils.monitor import recv_monitor_message

        front = self._publisher.socket
        poller = zmq.Poller()
        poller.register(front, zmq.POLLIN)
        poller.register(back, zmq.POLLIN)
        connected, end = 0, math.inf
        while True:
            if self._stop.is_set():
                end = min(end, time.monotonic() + self._linger)
            # Before the messages: what a publisher that has gone has sent is there by then.
            while connections.poll(0):
                is_new = recv_monitor_message(connections)["event"] == zmq.EVENT_CONNECTED
                connected += 1 if is_new else -1
            events = dict(poller.poll(POLL_MS))
            event = self._publisher.next_event()
            if event is not None:
                back.send(event)
            if back in events:
                front.send(back.recv())
            elif (end < math.inf and not connected) or time.monotonic() > end:
                return
