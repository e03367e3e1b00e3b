"""Faults of those who read what a run sends: pipes and ZeroMQ. They cost the run nothing."""

from __future__ import annotations

import fcntl
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zmq

from tactflow.engine.run import Runner
from tactflow.message import lines
from tests.clock import PATIENCE, until
from tests.faults.rig import FRAMES, Seen, array, run

SMALLEST_PIPE = 4096
"""Bytes that a pipe holds at least (Linux)."""
FAST = 100.0
"""Rate of a recording that is played as if it were live, Hz."""


@pytest.mark.parametrize(
    ("reader_does", "live", "code", "said", "kept"),
    [
        ("never comes, and a signal comes", False, 0, "^$", "some lines"),
        ("hangs, and a signal comes", False, 3, "are lost", ""),
        ("leaves", False, 3, "Broken pipe", "some lines"),
        ("hangs", True, 0, "too slow", "some dropped"),
        ("leaves", True, 3, "Broken pipe", "some lines"),
    ],
)
def test_the_reader_of_a_pipe(
    reader_does: str,
    live: bool,
    code: int,
    said: str,
    kept: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = None
    if "never comes" not in reader_does:
        reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        if "hangs" in reader_does:
            fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, SMALLEST_PIPE)

    def leave(_: Runner) -> None:
        if reader_does == "leaves" and reader is not None:
            os.close(reader)

    def send_signal(runner: Runner) -> None:
        if "hangs, and a signal" in reader_does:
            # More than the pipe takes.
            until(lambda: runner.progress().frames >= 20)
        elif "signal" in reader_does:
            time.sleep(0.3)
        if "signal" in reader_does:
            runner.stop("signal")

    monkeypatch.setattr(lines, "MAX_QUEUED_LINES", 10)
    pace = {"realtime": live, "fps": FAST if live else 30.0}
    sinks = {"jsonl": {"path": str(path), "flush": 0}}
    runner, seen = run(tmp_path, sinks, leave, send_signal, source=str(array(tmp_path)), **pace)
    if reader is not None and reader_does != "leaves":
        os.close(reader)
    node = runner.nodes.get("jsonl")
    counts = dict(node.sink.counters()) if node is not None and node.sink is not None else {}
    dropped = "some" if counts.get("dropped") else "no"
    left = f"{'all' if counts.get('lines') == FRAMES else 'some'} lines, {dropped} dropped"
    Seen(seen.exit, seen.said, left).must_be(code, said, kept)


@pytest.mark.parametrize("bad_one", ["reads nothing", "subscribes to 100 kB"])
def test_a_bad_subscriber_harms_no_other(bad_one: str, tmp_path: Path) -> None:
    with ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        context.setsockopt(zmq.LINGER, 0)
        address = f"tcp://127.0.0.1:{_free_port()}"
        received = stack.enter_context(_subscribed(context, address))

        def fault(_: Runner) -> None:
            bad = stack.enter_context(context.socket(zmq.SUB))
            bad.rcvhwm = 1
            bad.subscribe(b"" if bad_one == "reads nothing" else bytes(100_000))
            bad.connect(address)

        settings = {"endpoint": address, "wait_for_subscriber": PATIENCE, "backlog": 1000, "linger": 60}
        _, seen = run(tmp_path, {"zmq": settings}, fault, source=str(array(tmp_path)))
    seen.must_be(0)
    assert len(received) == FRAMES


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


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
