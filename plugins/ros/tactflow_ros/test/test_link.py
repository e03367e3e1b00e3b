"""The bridge's link to tactflow, which needs no ROS."""

from __future__ import annotations

import threading
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import zmq

PACKAGE = Path(__file__).parents[1] / "tactflow_ros"


@pytest.mark.parametrize("answer", [b"[" * 100_000, b'{"ok": {}', b"null", b"\xff", b"{}"])
def test_an_answer_to_a_command_that_is_not_tactflow_s_is_told(
    answer: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Not by the package, which imports ROS.
    monkeypatch.syspath_prepend(str(PACKAGE))
    link: Any = import_module("link")
    with zmq.Context() as context, context.socket(zmq.REP) as server:
        port = server.bind_to_random_port("tcp://127.0.0.1")
        replies = threading.Thread(target=lambda: (server.recv(), server.send(answer)))
        replies.start()
        ok, message = link.send_command(f"tcp://127.0.0.1:{port}", "pause", "", 30.0)
        replies.join()
    assert not ok
    assert message.endswith("not an answer of tactflow")
