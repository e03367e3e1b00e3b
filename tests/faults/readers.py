"""Faults of those who read what a run sends: pipes, ZeroMQ, the live page."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest
import zmq

from tactflow.engine.run import Runner
from tactflow.system import lines
from tests.clock import PATIENCE, until
from tests.faults.rig import FRAMES, Seen, array, run

SMALLEST_PIPE = 4096
"""Bytes that a pipe holds at least (Linux)."""
FAST = 100.0
"""Rate of a recording that is played as if it were live, Hz."""


def pipe(reader_does: str, folder: Path, *, live: bool) -> Seen:
    """Lines go to a pipe, whose reader never comes, hangs or leaves; a signal may come meanwhile."""
    path = folder / "pipe"
    os.mkfifo(path)
    reader = None
    if "never comes" not in reader_does:
        reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        if "hangs" in reader_does:
            fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, SMALLEST_PIPE)

    def fault(_: Runner) -> None:
        if reader_does == "leaves" and reader is not None:
            os.close(reader)

    def signal(runner: Runner) -> None:
        if "signal" in reader_does:
            if "hangs" in reader_does:
                # More than the pipe takes.
                until(lambda: runner.progress().frames >= 20)
            else:
                time.sleep(0.3)
            runner.stop("signal")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lines, "MOST_WAITING", 10)
        runner, seen = run(
            folder,
            {"jsonl": {"path": str(path), "flush": 0}},
            fault,
            signal,
            source=str(array(folder)),
            realtime=live,
            fps=FAST if live else 30.0,
        )
    if reader is not None and reader_does != "leaves":
        os.close(reader)
    node = runner.nodes.get("jsonl")
    counts = dict(node.sink.counters()) if node is not None and node.sink is not None else {}
    some = "some" if counts.get("dropped") else "no"
    return Seen(
        seen.exit, seen.said, f"{'all' if counts.get('lines') == FRAMES else 'some'} lines, {some} dropped"
    )


def zeromq(subscriber_does: str, folder: Path) -> Seen:
    """One good subscriber, and one that reads nothing, leaves at once, or sends what it should not."""
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        context.setsockopt(zmq.LINGER, 0)
        address = f"tcp://127.0.0.1:{_free_port()}"
        received = stack.enter_context(_subscribed(context, address))

        def fault(_: Runner) -> None:
            if subscriber_does == "reads nothing":
                idle = stack.enter_context(context.socket(zmq.SUB))
                idle.rcvhwm = 1
                idle.subscribe("")
                idle.connect(address)
            elif subscriber_does == "subscribes to 100 kB":
                loud = stack.enter_context(context.socket(zmq.SUB))
                loud.subscribe(bytes(100_000))
                loud.connect(address)
            else:
                _send_noise(address, 20)

        settings = {"endpoint": address, "wait_for_subscriber": PATIENCE, "backlog": 1000, "linger": 60}
        _, seen = run(folder, {"zmq": settings}, fault, source=str(array(folder)))
    return Seen(seen.exit, seen.said, f"the good one got {len(received)} messages")


@contextmanager
def _subscribed(context: zmq.Context[zmq.Socket[bytes]], address: str) -> Iterator[list[bytes]]:
    """The messages that a subscriber gets while a block lasts, and in the second after it."""
    received: list[bytes] = []
    ended = threading.Event()

    def listen() -> None:
        with context.socket(zmq.SUB) as socket:
            socket.subscribe("tactflow.main ")
            socket.connect(address)
            while socket.poll(1000) or not ended.is_set():
                if socket.poll(0):
                    received.append(socket.recv())

    thread = threading.Thread(target=listen)
    thread.start()
    try:
        yield received
    finally:
        ended.set()
        thread.join()


def page(visitor_does: str, folder: Path) -> Seen:
    """The live page is served while a visitor behaves badly."""
    answers: list[int] = []
    with ExitStack() as stack:

        def fault(runner: Runner) -> None:
            node = runner.nodes["view"]
            address = str(node.sink and node.sink.description)
            where = urlsplit(address)
            if visitor_does == "connects and is silent":
                for _ in range(20):
                    stack.enter_context(socket.create_connection((where.hostname, where.port)))
            elif visitor_does == "leaves in mid-request":
                for _ in range(20):
                    with socket.create_connection((where.hostname, where.port)) as visit:
                        visit.sendall(b"GET / HTTP/1.1\r\nHost: 127")
            else:
                _send_noise(f"tcp://{where.netloc}", 20)
            with urlopen(address, timeout=PATIENCE) as answer:
                answers.append(answer.status)

        _, seen = run(folder, {"view": {"port": 0}}, fault, source=str(array(folder)))
    return Seen(seen.exit, seen.said, f"the page answers {answers[0]}" if answers else "no answer")


def _send_noise(address: str, connections: int) -> None:
    where, noise = urlsplit(address), random.Random(1)
    for _ in range(connections):
        with socket.create_connection((where.hostname, where.port)) as visit:
            try:
                visit.sendall(noise.randbytes(100_000))
            except OSError:
                # It was thrown out.
                continue


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
