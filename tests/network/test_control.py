"""Control from outside: what is answered, whatever is asked, and that the run goes on."""

from __future__ import annotations

import json
import socket as system_socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest
import zmq

from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.engine.control import Control
from tactflow.engine.run import Runner
from tactflow.network.commands import ControlSocket
from tactflow.network.remote_control import RemoteControl
from tactflow.sinks.record import Record
from tactflow.sinks.zmq import Zmq
from tactflow.sources import open_source
from tests.clock import PATIENCE, until

ANY_PORT = "tcp://127.0.0.1:*"
PIPELINE = """
stages:
  capture: {source: "sim:press?frames=100000", realtime: true}
sinks:
  record: {path: touch.mcap, trigger: button}
  zmq: {endpoint: "tcp://127.0.0.1:*", control: "tcp://127.0.0.1:*"}
"""


@pytest.fixture
def bare() -> Iterator[ControlSocket]:
    """The socket of a run that can do nothing."""
    socket = ControlSocket(ANY_PORT, None, "main", None)
    yield socket
    socket.close()


def test_a_run_carries_out_commands_and_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    monkeypatch.chdir(tmp_path)
    runner = Runner(load_pipeline(tmp_path / "pipeline.yaml"))
    thread = threading.Thread(target=runner.run)
    thread.start()
    try:
        until(lambda: "zmq" in runner.nodes and cast(Zmq, runner.nodes["zmq"].sink).control_endpoint)
        with RemoteControl(cast(Zmq, runner.nodes["zmq"].sink).control_endpoint or "", PATIENCE) as run:
            assert run.ping()["state"]["sensor"] == "main"
            assert run.record_start()["message"] == "recording to touch-001.mcap"
            assert run.record_start()["message"] == "is recording already to touch-001.mcap"
            until(lambda: run.stats()["stats"]["sinks"]["record"]["counters"]["frames"] > 3)
            assert "reference" in run.take_reference()["message"]
            # On a busy machine, frames from before wait in front of the sink.
            waited = run.stats()["stats"]["sinks"]["record"]["counters"]["frames"] + Record.queue_capacity + 5
            until(lambda: run.stats()["stats"]["sinks"]["record"]["counters"]["frames"] > waited)
            state = {"sensor": "main", "paused": True, "recording": True, "source": "running"}
            assert run.pause()["state"] == state
            answer = run.record_stop()
            assert (answer["message"], answer["path"]) == ("recorded to touch-001.mcap", "touch-001.mcap")
            assert run.record_stop()["message"] == "nothing was being recorded"
            assert run.resume()["message"] == "running"
    finally:
        runner.stop()
        thread.join()
    recording = open_source("touch-001.mcap")
    epochs = [frame.epoch for frame in iter(recording.read_arrival, None)]
    recording.close()
    assert epochs[0] == 0
    assert epochs[-1] == 1


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (b"pause", "required one JSON object"),
        (b"[]", "required one JSON object"),
        (b"[" * 4000, "required one JSON object"),
        (b'{"do": ["pause"]}', "there is no command"),
        (b'{"do": "stop"}', "there is no command 'stop'; there are ping, stats"),
        (b'{"do": "pause"}', "the run cannot be controlled"),
    ],
)
def test_what_cannot_be_done_is_answered_with_a_reason(
    bare: ControlSocket, request_: bytes, words: str
) -> None:
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.connect(bare.endpoint)
        socket.send(request_)
        answer = json.loads(socket.recv())
    assert not answer["ok"]
    assert words in answer["message"]


def test_a_command_that_fails_is_answered_and_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    class Broken:
        source = None
        paused = False

        def recorder(self) -> None: ...

        def pause(self, paused: bool) -> None:
            raise OSError(f"no space left, {paused}")

        def snapshot(self) -> dict[str, object]:
            return {"counters": object()}

    socket = ControlSocket(ANY_PORT, None, "main", cast(Control, Broken()))
    try:
        with RemoteControl(socket.endpoint, PATIENCE) as run:
            with pytest.raises(RuntimeError, match="no space left"):
                run.pause()
            with pytest.raises(RuntimeError, match=r"no record sink .* adds one"):
                run.record_start()
            with pytest.raises(RuntimeError, match="not JSON serializable: object"):
                run.stats()
            assert run.ping()["message"] == "here"
    finally:
        socket.close()
    assert "no space left" in caplog.text


def test_what_is_too_long_or_no_request_is_dropped(bare: ControlSocket) -> None:
    host, _, port = bare.endpoint.removeprefix("tcp://").rpartition(":")
    with system_socket.create_connection((host, int(port))) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\n\r\n" * 100)
    with zmq.Context() as context, context.socket(zmq.DEALER) as junk:
        junk.linger = 0
        junk.connect(bare.endpoint)
        for parts in ([b""], [b"", b"{}", b"{}"], [b"no delimiter"], [b"", b"x" * 100_000]):
            junk.send_multipart(parts)
        with RemoteControl(bare.endpoint, PATIENCE) as run:
            assert run.ping()["ok"]


@pytest.mark.parametrize("answer", [b"[", b"[]", b'{"ok": true, "message": "here"}', b'{"state": 5}'])
def test_an_answer_of_another_program_is_an_error(answer: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    with zmq.Context() as context, context.socket(zmq.REP) as stranger:
        port = stranger.bind_to_random_port("tcp://127.0.0.1")
        thread = threading.Thread(target=lambda: (stranger.recv(), stranger.send(answer)))
        thread.start()
        assert main(["control", "ping", f"tcp://127.0.0.1:{port}"]) == 3
        thread.join()
    assert "does not answer as tactflow does" in capsys.readouterr().err


def test_the_command_says_what_happened_and_what_did_not(
    bare: ControlSocket, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["control", "ping", bare.endpoint]) == 0
    assert capsys.readouterr().out == "main: here\n"
    assert main(["control", "stats", bare.endpoint]) == 0
    assert json.loads(capsys.readouterr().out) == {}
    assert main(["control", "take-reference", bare.endpoint]) == 3
    assert "the run cannot be controlled" in capsys.readouterr().err
    assert main(["control", "pause", f"ipc://{tmp_path}/nobody", "--timeout", "0.05"]) == 4
    assert "sinks.zmq.control" in capsys.readouterr().err
    assert main(["control", "explode", bare.endpoint]) == 2
    assert main(["control", "ping", "nowhere"]) == 2
    for folder in (str(tmp_path), "~nobody-of-this-name/keys"):
        assert main(["control", "ping", "--keys", folder]) == 2
