"""Several sensors: one process each, one address for subscribers, and failures that stay where they are."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zmq

from tactflow.cli.main import main
from tactflow.sources import open_source
from tests.clock import PATIENCE, until

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
  preprocess: {rotate: 90}
sinks:
  jsonl: {path: "out-{sensor}.jsonl"}
"""


def start(folder: Path, *words: str, **options: Any) -> subprocess.Popen[str]:
    """Start tactflow in a folder, with its errors in a pipe."""
    options = {"stderr": subprocess.PIPE, "text": True} | options
    return subprocess.Popen([sys.executable, "-m", "tactflow", *words], cwd=folder, **options)


def run(folder: Path, *words: str, **options: Any) -> tuple[int, str]:
    """Run tactflow in a folder; its exit code and errors."""
    process = start(folder, *words, **options)
    errors = process.communicate(timeout=PATIENCE)[1]
    return process.returncode, errors


def rows(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def numbers(path: Path) -> list[int]:
    """Of the frames in a recording."""
    source = open_source(str(path))
    found = [frame.seq for frame in iter(source.read_arrival, None)]
    source.close()
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pipeline.yaml").write_text(GRAPH)
    return tmp_path


NOISY = """
import sys

from tactflow.stages.capture import Capture


class Noisy(Capture):
    def open(self) -> None:
        sys.stderr.buffer.write(b"no text: \\xff\\n")
        print("and more", file=sys.stderr, flush=True)
        super().open()
"""


class Whole(NamedTuple):
    """What a run of both sensors has left behind and said."""

    folder: Path
    out: bytes
    errors: bytes


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """A run of both sensors from its start to its end, for many tests."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "noisy.py").write_text(NOISY)
    (folder / "select.py").write_text("open('taken', 'w').close()\n")
    text = GRAPH.replace(
        'capture: {source: "sim:press', "capture: {use: './noisy.py:Noisy', source: \"sim:press"
    )
    (folder / "pipeline.yaml").write_text(text)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "tactflow", "run", "--stats", "stats.json", "--jsonl", "-"],
        cwd=folder,
        capture_output=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return Whole(folder, done.stdout, done.stderr)


def test_each_sensor_runs_the_graph_with_its_own_changes(whole: Whole) -> None:
    left, right = rows(whole.folder / "out-left.jsonl"), rows(whole.folder / "out-right.jsonl")
    assert [len(left), len(right)] == [40, 30]
    assert {row["sensor"] for row in left} == {"left"}
    assert left[0]["size"] == [600, 800]
    assert right[0]["size"] == [800, 600]
    assert json.loads((whole.folder / "stats-left.json").read_text())["frames"] == 40
    assert b"[left] 40 frames" in whole.errors


def test_lines_on_standard_output_do_not_mix(whole: Whole) -> None:
    counts = Counter(json.loads(line)["sensor"] for line in whole.out.splitlines())
    assert counts == {"left": 40, "right": 30}


def test_what_is_no_text_on_standard_error_is_passed_on_with_what_follows(whole: Whole) -> None:
    assert b"[left] no text: \xff\n" in whole.errors
    assert b"[left] and more\n" in whole.errors


def test_a_file_in_the_current_folder_is_not_taken_for_a_module_of_python(whole: Whole) -> None:
    assert not (whole.folder / "taken").exists()


def test_one_sensor_can_be_run_alone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert main(["run", "--sensor", "right", "--quiet"]) == 0
    assert not (folder / "out-left.jsonl").exists()
    assert len(rows(folder / "out-right.jsonl")) == 30


def test_all_sensors_publish_at_one_address(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The addresses between the processes have to be short, wherever temporary files go.
    long = folder / ("x" * 100)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    with zmq.Context() as context, context.socket(zmq.SUB) as socket, context.socket(zmq.REP) as finder:
        port = finder.bind_to_random_port("tcp://127.0.0.1")
        finder.unbind(f"tcp://127.0.0.1:{port}")
        socket.linger = 0
        socket.rcvtimeo = round(PATIENCE * 1000)
        socket.subscribe("tactflow.")
        socket.connect(f"tcp://127.0.0.1:{port}")
        sink = f"sinks.zmq={{endpoint: 'tcp://127.0.0.1:{port}', wait_for_subscriber: {PATIENCE}}}"
        more = ("--set", "sinks.zmq.backlog=100", "--set", "sinks.zmq.linger=60")
        process = start(folder, "run", "--quiet", "--set", sink, *more, stderr=subprocess.DEVNULL)
        counts: Counter[bytes] = Counter()
        while sum(counts.values()) < 70:
            counts[socket.recv().partition(b" ")[0]] += 1
        assert process.wait(PATIENCE) == 0
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
    for name in ("a-left.mcap", "a-right.mcap"):
        (folder / name).write_bytes(b"old")
    options = ("--out", "a.mcap", "--overwrite", "--jsonl", "more.jsonl", "--quiet")
    code, errors = run(folder, "record", *options)
    assert code == 0, errors
    assert "left failed (exit code 4); starting again in 1 s" in errors
    assert "the cable is loose" in errors
    assert (folder / "attempts").read_text() == "xx"
    for file in ("out-left.jsonl", "more-left.jsonl"):
        assert [row["seq"] for row in rows(folder / file)] == [*range(10), *range(40)], "nothing is lost"
    for file in ("out-right.jsonl", "more-right.jsonl"):
        assert len(rows(folder / file)) == 30
    assert errors.count("right failed") == 0
    recorded = {path.name: numbers(path) for path in folder.glob("*.mcap")}
    assert recorded == {
        "a-left.mcap": list(range(10)),
        "a-left-001.mcap": list(range(40)),
        "a-right.mcap": list(range(30)),
    }


def test_a_file_that_may_not_be_touched_is_refused_for_good(folder: Path) -> None:
    old = folder / "out-left.jsonl"
    old.write_text("{}\n")
    code, errors = run(folder, "run", "--quiet")
    assert code == 3
    assert "this file exists" in errors
    assert "left failed (exit code 3); given up, as out-left.jsonl may not be replaced" in errors
    assert "starting again" not in errors
    assert old.read_text() == "{}\n"
    assert len(rows(folder / "out-right.jsonl")) == 30


def test_the_run_goes_on_when_nobody_reads_its_lines_any_more(folder: Path) -> None:
    process = start(folder, "run", "--quiet", "--jsonl", "-", stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    # Before the first line, so that every sensor's lines find nobody.
    process.stdout.close()
    with process.stderr as stream:
        errors = stream.read()
    assert process.wait(PATIENCE) == 0
    # What is done to the frames is told as ever; nobody complains.
    assert [line for line in errors.splitlines() if not line.endswith(": stages.preprocess")] == []
    assert len(rows(folder / "out-left.jsonl")) == 40
    assert len(rows(folder / "out-right.jsonl")) == 30


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_behind_standard_output_ends_the_run_with_an_error(folder: Path) -> None:
    text = GRAPH.replace("frames=40", "frames=90000").replace("frames=30", "frames=90000")
    (folder / "pipeline.yaml").write_text(text)
    with open("/dev/full", "w") as full:
        code, errors = run(folder, "run", "--quiet", "--jsonl", "-", stdout=full)
    assert code == 3
    # What is done to the frames may be told before the end.
    complaints = [line for line in errors.splitlines(True) if not line.endswith(": stages.preprocess\n")]
    assert "".join(complaints) == "tactflow: standard output: No space left on device; the run ends\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_one_signal_ends_all_sensors_well(folder: Path, number: int) -> None:
    (folder / "pipeline.yaml").write_text(
        GRAPH.replace("frames=40", "frames=90000").replace("frames=30", "frames=90000")
    )
    process = start(folder, "run", "--stats", "stats.json")
    files = [folder / "out-left.jsonl", folder / "out-right.jsonl"]
    until(lambda: process.poll() is not None or all(file.exists() and file.stat().st_size for file in files))
    assert process.poll() is None
    process.send_signal(number)
    _, errors = process.communicate(timeout=PATIENCE)
    if number == signal.SIGINT:
        assert process.returncode == 0, errors
        assert errors.count("(stopped)") == 2
    # The last that a sensor writes, also where nobody is left to tell it.
    statistics = [folder / "stats-left.json", folder / "stats-right.json"]
    until(lambda: all(file.exists() and file.read_text().endswith("}\n") for file in statistics))
    for file in files:
        assert [row["seq"] for row in rows(file)] == list(range(len(rows(file))))


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (GRAPH.replace("out-{sensor}.jsonl", "out.jsonl"), [], "left and right would both write out.jsonl"),
        (GRAPH, ["--source", "sim:idle"], "each with its own source"),
        (GRAPH, ["--sensor", "lefft"], "did you mean left?"),
        (
            GRAPH,
            ["--set", "sinks.jsonl_2={use: jsonl, path: same.jsonl}"],
            "left and right would both write same.jsonl",
        ),
        (
            GRAPH,
            ["--set", "sinks.zmq={control: 'tcp://127.0.0.1:5557'}"],
            "left and right would both listen at tcp://127.0.0.1:5557; "
            "give right its own, as sensors.right.sinks.zmq.control",
        ),
        (GRAPH.replace("rotate: 0", "rotate: 7"), [], "pipeline.yaml:8:20"),
        (GRAPH.replace("  left: {stages:", "  left: {stagse:"), [], "sensors.left.stagse: unknown key"),
        (GRAPH.replace("  left:", "  'le ft':"), [], "should be a word of letters"),
        (GRAPH.replace("left:", "stats:"), [], "give the sensor another name"),
        (GRAPH + "sensor: main\n", [], "remove this key"),
        (
            "sensors: []\n" + GRAPH[GRAPH.index('stages:\n  capture: {source: "sim:idle"}') :],
            [],
            "should be a mapping",
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


def test_check_reports_each_mistake_of_all_sensors_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    file = folder / "pipeline.yaml"
    # All sensors may write to one device.
    file.write_text(GRAPH.replace("out-{sensor}.jsonl", "/dev/null"))
    assert main(["check"]) == 0
    assert [line.split(" (")[0] for line in capsys.readouterr().out.splitlines()] == [
        "pipeline.yaml: sensor left OK",
        "pipeline.yaml: sensor right OK",
    ]
    text = GRAPH.replace("out-{sensor}.jsonl", "out.jsonl").replace("rotate: 90", "rotate: 90, downsample: 0")
    file.write_text(text.replace("rotate: 0", "rotate: 7"))
    assert main(["check"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("tactflow: 2 mistakes\n")
    assert captured.err.count("downsample: ") == 2, "the message, and the line of the file"
    file.write_text(text.replace(", downsample: 0", ""))
    assert main(["check"]) == 2
    assert "sinks.jsonl.path: left and right would both write out.jsonl" in capsys.readouterr().err
