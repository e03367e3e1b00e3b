"""Several sensors: one process each, one address for subscribers, and failures that stay where they are."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import zmq

from tactflow.cli.fleet import with_name
from tactflow.cli.main import main

GRAPH = """
opencv_threads: 1
sensors:
  left: {stages: {capture: {source: "sim:press?frames=40"}}}
  right:
    stages:
      capture: {source: "sim:idle?frames=30"}
      preprocess: {rotate: 0}
stages:
  capture: {source: "sim:idle"}
  preprocess: {rotate: 90, downsample: 2}
sinks:
  jsonl: {path: "out-{sensor}.jsonl"}
"""


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tactflow", "run", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def rows(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pipeline.yaml").write_text(GRAPH)
    return tmp_path


def test_each_sensor_runs_the_graph_with_its_own_changes(folder: Path) -> None:
    done = run("--stats", "stats.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    left, right = rows(folder / "out-left.jsonl"), rows(folder / "out-right.jsonl")
    assert [len(left), len(right)] == [40, 30]
    assert {row["sensor"] for row in left} == {"left"}
    assert left[0]["size"] == [300, 400]
    assert right[0]["size"] == [400, 300]
    assert json.loads((folder / "stats-left.json").read_text())["frames"] == 40
    assert "[left] 40 frames" in done.stderr


def test_one_sensor_can_be_run_alone(folder: Path) -> None:
    assert run("--sensor", "right", "--quiet", cwd=folder).returncode == 0
    assert not (folder / "out-left.jsonl").exists()
    assert len(rows(folder / "out-right.jsonl")) == 30


def test_lines_on_standard_output_do_not_mix(folder: Path) -> None:
    done = run("--set", "sinks.jsonl=null", "--jsonl", "-", "--quiet", cwd=folder)
    assert done.returncode == 0, done.stderr
    counts = Counter(json.loads(line)["sensor"] for line in done.stdout.splitlines())
    assert counts == {"left": 40, "right": 30}


def test_all_sensors_publish_at_one_address(folder: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.SUB) as socket, context.socket(zmq.REP) as finder:
        port = finder.bind_to_random_port("tcp://127.0.0.1")
        finder.unbind(f"tcp://127.0.0.1:{port}")
        socket.linger = 0
        socket.rcvtimeo = 20_000
        socket.subscribe("tactflow.")
        socket.connect(f"tcp://127.0.0.1:{port}")
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "tactflow", "run", "--quiet"),
                *("--set", f"sinks.zmq={{endpoint: 'tcp://127.0.0.1:{port}', wait_for_subscriber: 20}}"),
                *("--set", "sinks.zmq.backlog=100"),
            ],
            cwd=folder,
            stderr=subprocess.DEVNULL,
        )
        counts: Counter[bytes] = Counter()
        while sum(counts.values()) < 70:
            counts[socket.recv().partition(b" ")[0]] += 1
        assert process.wait(30) == 0
    assert counts == {b"tactflow.left": 40, b"tactflow.right": 30}


FLAKY = """
from collections.abc import Iterator
from pathlib import Path

from tactflow.engine.frame import Frame
from tactflow.stages.capture import Capture


class Flaky(Capture):
    def frames(self) -> Iterator[Frame]:
        trace = Path("attempts")
        first = not trace.exists()
        with trace.open("a") as file:
            file.write("x")
        for frame in super().frames():
            if first and frame.seq == 10:
                raise OSError("the cable is loose")
            yield frame
"""


def test_a_sensor_that_fails_is_started_again_and_the_others_are_not_disturbed(folder: Path) -> None:
    (folder / "flaky.py").write_text(FLAKY)
    text = GRAPH.replace(
        'capture: {source: "sim:press', "capture: {use: './flaky.py:Flaky', source: \"sim:press"
    )
    (folder / "pipeline.yaml").write_text(text)
    done = run("--quiet", "--jsonl", "more.jsonl", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "left failed (exit code 4); starting again in 1 s" in done.stderr
    assert "the cable is loose" in done.stderr
    assert (folder / "attempts").read_text() == "xx"
    for file in ("out-left.jsonl", "more-left.jsonl"):
        assert [row["seq"] for row in rows(folder / file)] == [*range(10), *range(40)], "nothing is lost"
    assert len(rows(folder / "out-right.jsonl")) == 30
    assert done.stderr.count("right failed") == 0


def test_one_signal_ends_all_sensors_well(folder: Path) -> None:
    (folder / "pipeline.yaml").write_text(
        GRAPH.replace("frames=40", "frames=90000").replace("frames=30", "frames=90000")
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "tactflow", "run"], cwd=folder, stderr=subprocess.PIPE, text=True
    )
    files = [folder / "out-left.jsonl", folder / "out-right.jsonl"]
    while not all(file.exists() and file.stat().st_size for file in files):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=40)
    assert process.returncode == 0, errors
    assert errors.count("(signal)") == 2
    for file in files:
        assert [row["seq"] for row in rows(file)] == list(range(len(rows(file))))


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (GRAPH.replace("out-{sensor}.jsonl", "out.jsonl"), [], "left and right would both write out.jsonl"),
        (GRAPH, ["--source", "sim:idle"], "each with its own source"),
        (GRAPH, ["--sensor", "lefft"], "did you mean left?"),
        (GRAPH.replace("rotate: 0", "rotate: 7"), [], "pipeline.yaml:8:28"),
        (GRAPH.replace("  left: {stages:", "  left: {stagse:"), [], "did you mean stages?"),
        (GRAPH.replace("  left:", "  'le ft':"), [], "a name is a word"),
        (GRAPH.replace("left:", "stats:"), [], "give the sensor another name"),
        (GRAPH + "sensor: main\n", [], "already; leave this one out"),
        (
            "sensors: []\n" + GRAPH[GRAPH.index('stages:\n  capture: {source: "sim:idle"}') :],
            [],
            "expected a mapping",
        ),
    ],
)
def test_mistakes_are_told_before_anything_starts(
    text: str,
    options: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "pipeline.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    assert main(["run", *options]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.out == ""
    assert [file.name for file in tmp_path.iterdir()] == ["pipeline.yaml"]


def test_an_address_that_is_taken_is_told(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with zmq.Context() as context, context.socket(zmq.REP) as taken:
        port = taken.bind_to_random_port("tcp://127.0.0.1")
        assert main(["run", "--set", f"sinks.zmq={{endpoint: 'tcp://127.0.0.1:{port}'}}"]) == 3
    assert "cannot be bound" in capsys.readouterr().err


def test_check_looks_at_every_sensor(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert main(["check"]) == 0
    assert [line.split(" (")[0] for line in capsys.readouterr().out.splitlines()] == [
        "pipeline.yaml: sensor left OK",
        "pipeline.yaml: sensor right OK",
    ]


@pytest.mark.parametrize(
    ("path", "expected"),
    [("-", "-"), ("out.jsonl", "out-a.jsonl"), ("x/{sensor}/o.json", "x/a/o.json"), ("plain", "plain-a")],
)
def test_files_of_the_command_line_get_the_sensors_name(path: str, expected: str) -> None:
    assert with_name(path, "a") == expected
