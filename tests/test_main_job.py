"""The main job from outside: the program as its users run it, and a subscriber in another process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import orjson
import pytest
import yaml
import zmq

from tactflow.cli.main import main
from tactflow.message.schema import message_schema
from tests.clock import PATIENCE, until

REPOSITORY = Path(__file__).resolve().parents[1]
PIPELINE = REPOSITORY / "pipeline.yaml"
SHIPPED = yaml.safe_load(PIPELINE.read_text())
WITHOUT = {name: ("--set", f"sinks.{name}=null") for name in SHIPPED["sinks"]}
NO_SINKS = tuple(word for words in WITHOUT.values() for word in words)
ONLY_ZMQ = tuple(word for name, words in WITHOUT.items() if name != "zmq" for word in words)


def messages(text: str) -> list[dict[str, Any]]:
    """Standard output as messages; anything else on it is an error here."""
    return [orjson.loads(line) for line in text.splitlines()]


@pytest.fixture
def subscriber() -> Iterator[zmq.Socket[bytes]]:
    """A subscriber that binds nothing and connects when the test says where."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.SUBSCRIBE, b"tactflow.")
        socket.rcvtimeo = round(PATIENCE * 1000)
        socket.linger = 0
        yield socket


def free_endpoint() -> str:
    """An address that nobody listens on."""
    with zmq.Context() as context, context.socket(zmq.REP) as socket:
        socket.linger = 0
        port = socket.bind_to_random_port("tcp://127.0.0.1")
    return f"tcp://127.0.0.1:{port}"


def test_the_main_job_gives_one_valid_message_a_frame_and_nothing_else_on_standard_output() -> None:
    words = ("pipeline.yaml", *NO_SINKS, "--source", "sim:press?frames=60", "--jsonl", "-")
    done = subprocess.run(
        [sys.executable, "-m", "tactflow", "run", *words],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rows = messages(done.stdout)
    validator = jsonschema.Draft202012Validator(message_schema())
    # Each takes longer to validate than to compute.
    for row in rows[::10]:
        validator.validate(row)
    assert [row["seq"] for row in rows] == list(range(60))
    assert {tuple(row["size"]) for row in rows} == {(300, 400)}
    assert any(row["contact"] for row in rows)
    assert rows[0]["contact"] is None
    assert len(rows[0]["markers"]["origin"]) == 80
    for row in rows:
        assert (row["contact"] is None) == (row["flow"] is None)
        assert row["contact"] is not None or row["skipped"]["contact"] == "no_contact"


def test_real_rolls_give_a_valid_message_a_frame_with_every_marker_found(
    shared_data: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.jsonl"
    pipeline, source = str(REPOSITORY / "pipelines" / "wedge.yaml"), str(shared_data / "wedge_roll")
    sinks = ("--set", "sinks.zmq=null", "--set", "sinks.view=null", "--set", f"sinks.jsonl.path={out}")
    assert main(["run", pipeline, *sinks, "--source", source, "--quiet"]) == 0
    rows = messages(out.read_text())
    validator = jsonschema.Draft202012Validator(message_schema())
    # Each takes longer to validate than to compute.
    for row in rows[::10]:
        validator.validate(row)
    assert len(rows) == 301
    assert len(rows[0]["markers"]["origin"]) == 140
    assert {len(row["markers"]["position"]) for row in rows} == {140}
    assert sum(row["contact"] is not None for row in rows) > 250


def test_a_subscriber_in_another_process_gets_every_message_of_a_run(
    subscriber: zmq.Socket[bytes], tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    subscriber.connect(endpoint)
    stats = tmp_path / "stats.json"
    with subprocess.Popen(
        [
            *(sys.executable, "-m", "tactflow", "run", "pipeline.yaml", *ONLY_ZMQ, "--quiet"),
            *(
                "--set",
                f"sinks.zmq.endpoint={endpoint}",
                "--set",
                f"sinks.zmq.wait_for_subscriber={PATIENCE}",
            ),
            *("--set", "sinks.zmq.backlog=50", "--set", "sinks.zmq.linger=60"),
            *("--source", "sim:press?frames=50", "--stats", str(stats)),
        ],
        cwd=REPOSITORY,
    ) as process:
        got = []
        while len(got) < 50:
            topic, _, body = subscriber.recv().partition(b" ")
            assert topic == b"tactflow.main"
            got.append(json.loads(body))
        assert process.wait(PATIENCE) == 0
    assert [message["seq"] for message in got] == list(range(50))
    jsonschema.validate(got[-1], message_schema())
    assert json.loads(stats.read_text())["sinks"]["zmq"]["counters"]["serialised"] == 50


# -- exit codes -------------------------------------------------------------------------------------------


def started(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    """Start an endless run that has delivered its first messages."""
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "tactflow", "run", str(REPOSITORY / "pipeline.yaml"), *NO_SINKS),
            *("--source", "sim:press?frames=100000", "--jsonl", "out.jsonl", *arguments),
        ],
        cwd=cwd,
        stderr=subprocess.PIPE,
        text=True,
    )
    out = cwd / "out.jsonl"
    until(lambda: process.poll() is not None or (out.exists() and out.stat().st_size))
    assert process.poll() is None, process.communicate()[1]
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_drains_and_finalises(number: int, tmp_path: Path) -> None:
    process = started("--stats", "stats.json", cwd=tmp_path)
    process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    stats = json.loads((tmp_path / "stats.json").read_text())
    assert stats["end"] == "signal"
    rows = messages((tmp_path / "out.jsonl").read_text())
    assert [row["seq"] for row in rows] == list(range(stats["frames"]))


SLOW = f"""
import time
from pathlib import Path
from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.control import Control
from tactflow.ports import Image

class Slow(Stage):
    memory = "pure"
    def __init__(self, params: StageParams, control: Control) -> None:
        super().__init__(params)
        self.run = control
    def process(self, image: Image) -> Image:
        Path("began").touch()
        while not self.run.hurried:
            time.sleep(0.001)
        Path("told").touch()
        time.sleep({PATIENCE})
        return image
"""
"""A stage that works on, also when the run is told to end."""


def test_a_second_signal_ends_at_once_with_130(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "pipeline.yaml").write_text(
        "stages:\n  capture: {source: 'sim:idle?frames=50'}\n  preprocess: {}\n"
        "  slow: {use: './slow.py:Slow'}\nsinks:\n  jsonl: {path: out.jsonl}\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "tactflow", "run"], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    until(lambda: process.poll() is not None or (tmp_path / "began").exists())
    assert process.poll() is None, process.communicate()[1]
    process.send_signal(signal.SIGINT)
    # Two at once may arrive as one.
    until(lambda: process.poll() is not None or (tmp_path / "told").exists())
    assert process.poll() is None, "one signal waits for the frame under way"
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 130


NEVER_DONE = """
from pathlib import Path
import cv2
import numpy as np
from tactflow.engine.contract import Stage
from tactflow.ports import Image

class NeverDone(Stage):
    memory = "pure"
    def process(self, image: Image) -> Image:
        pixels = np.zeros((200, 200), np.float32)
        Path("began").touch()
        while True:
            cv2.blur(pixels, (3, 3))
"""


def test_a_thread_that_is_in_opencv_does_not_change_the_exit_code(tmp_path: Path) -> None:
    (tmp_path / "busy.py").write_text(NEVER_DONE)
    (tmp_path / "pipeline.yaml").write_text(
        "stages:\n  capture: {source: 'sim:idle?frames=50'}\n  preprocess: {}\n"
        "  busy: {use: './busy.py:NeverDone'}\nsinks:\n  jsonl: {path: out.jsonl}\n"
    )
    command = [sys.executable, "-m", "tactflow", "run", "--quiet"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        until(lambda: process.poll() is not None or (tmp_path / "began").exists())
        process.send_signal(signal.SIGINT)
        # Two of the same at once may arrive as one.
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, errors) == (130, "")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "missing.yaml"], 2, "missing.yaml"),
        (["run", "--set", "stages.hull.min_aera=3"], 2, "did you mean min_area?"),
        (["run", "--source", "sim:pres"], 4, "press"),
        (["run", "--source", "missing.mp4"], 4, "missing.mp4"),
        (["run", "--source", "/dev/video97"], 4, "/dev/video97"),
        (["run", "--jsonl", "/proc/nowhere/out.jsonl"], 3, "/proc/nowhere"),
        (["run", "--jsonl", "/dev/full", "--source", "sim:idle?frames=30"], 3, "/dev/full"),
        (["run", "--stats", "/proc/nowhere.json"], 2, "--stats"),
    ],
)
def test_a_user_mistake_ends_with_its_code_and_advice(
    arguments: list[str],
    code: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    extra = [*NO_SINKS] if arguments[0] == "run" and "missing.yaml" not in arguments else []
    found = main([*arguments, *extra])
    out, errors = capfd.readouterr()
    assert found == code, errors
    assert words in errors
    assert "Traceback" not in errors
    assert out == ""
