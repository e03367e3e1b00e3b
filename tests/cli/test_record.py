"""`tactflow record`, its replay, and `tactflow repair`."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from tactflow.cli.main import main
from tactflow.sim import open_scene
from tactflow.sources import Arrival, open_source
from tests.terminal import Terminal

QUIET = ["--quiet", "--set", "sinks.zmq=null", "--set", "sinks.jsonl=null", "--set", "sinks.view=null"]


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def record_and_replay(folder: Path, *options: str, replay: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Run with a recording, play it, and compare every result, bit for bit; the results."""
    live, again, out = folder / "live.jsonl", folder / "again.jsonl", folder / "a.mcap"
    assert main(["record", *QUIET, *options, "--jsonl", str(live), "--out", str(out)]) == 0
    kept = [option for option in options if option != "--realtime"]
    del kept[kept.index("--source") : kept.index("--source") + 2]
    command = ["run", *QUIET, *kept, *replay, "--source", str(out), "--jsonl", str(again)]
    assert main(command) == 0
    assert live.read_text() == again.read_text()
    return lines(live)


def test_replay_is_equal_where_the_live_run_dropped_frames(tmp_path: Path) -> None:
    # Frames that are there already come at 1000 a second, more than any machine works on.
    scene = open_scene("press?frames=120")
    np.save(tmp_path / "fast.npy", np.stack([scene.frame(i) for i in range(120)]))
    source = ("--source", str(tmp_path / "fast.npy"), "--set", "stages.capture.fps=1000")
    results = record_and_replay(tmp_path, *source, "--realtime")
    seqs = [result["seq"] for result in results]
    assert 1 < len(seqs) < 120
    assert max(b - a for a, b in pairwise(seqs)) > 1


def test_replay_is_equal_across_a_new_reference(tmp_path: Path) -> None:
    sink = tmp_path / "again.py"
    sink.write_text(
        "from tactflow.engine.frame import Tick\n"
        "from tactflow.engine.contract import Sink\n"
        "class Again(Sink):\n"
        "    def __init__(self, params, control=None):\n"
        "        self.control = control\n"
        "    def write(self, tick: Tick) -> None:\n"
        "        if tick.frame.seq == 20:\n"
        "            self.control.retake_reference()\n"
    )
    results = record_and_replay(
        tmp_path,
        *("--source", "sim:press?frames=60", "--set", "stages.capture.reference=3"),
        *("--set", f"sinks.again={{use: '{sink}:Again'}}"),
        replay=("--set", "sinks.again=null"),
    )
    assert len(results) == 60
    assert any(result["contact"] for result in results)
    assert any(result["markers"] for result in results)
    epochs = {frame.epoch for frame in frames_of(tmp_path / "a.mcap")}
    assert epochs == {0, 1}


def frames_of(path: Path) -> list[Arrival]:
    return list(iter(open_source(str(path)).read_arrival, None))


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("a.avi", "required a file whose name ends in .mcap"),
        ("there.mcap", "already exists; give --overwrite"),
    ],
)
def test_a_wrong_file_is_refused_before_anything_starts(
    tmp_path: Path, out: str, words: str, terminal: Terminal
) -> None:
    (tmp_path / "there.mcap").write_bytes(b"precious")
    assert terminal("record", *QUIET, "--source", "sim:press?frames=3", "--out", str(tmp_path / out)) == 2
    assert words in terminal.err
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"


def test_number_records_beside_what_is_there_and_overwrite_replaces_it(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    command = ["record", *QUIET, "--source", "sim:press?frames=2", "--out", str(out), "--number"]
    for _ in range(3):
        assert main(command) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-001.mcap", "a-002.mcap", "a.mcap"]
    out.write_bytes(b"old")
    assert main([*command[:-1], "--overwrite"]) == 0
    assert len(frames_of(out)) == 2


def test_repair_leaves_a_whole_file_alone_and_replaces_nothing_unasked(
    tmp_path: Path, terminal: Terminal
) -> None:
    out, copy, folder = tmp_path / "a.mcap", tmp_path / "b.mcap", tmp_path / "kept"
    assert terminal("record", *QUIET, "--source", "sim:press?frames=3", "--out", str(out)) == 0
    whole = out.read_bytes()
    assert terminal("repair", str(out)) == 0
    assert "is intact; nothing to repair" in terminal.err
    assert out.read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    out.write_bytes(whole[:-200])
    copy.write_bytes(b"precious")
    folder.mkdir()
    for words, message in (
        (["--out", str(copy)], "--overwrite"),
        (["--out", str(folder), "--overwrite"], f"--out: {folder} is a folder; required a file"),
        (["--out", str(out), "--overwrite"], "is the file to repair"),
    ):
        assert terminal("repair", str(out), *words) == 2
        assert message in terminal.err
    assert copy.read_bytes() == b"precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "b.mcap", "kept"]
    assert terminal("repair", str(out), "--out", str(copy), "--overwrite") == 0
    assert out.read_bytes() == whole[:-200]
    with copy.open("rb") as file:
        assert make_reader(file).get_summary() is not None
    assert len(frames_of(copy)) == 3


@pytest.mark.parametrize(("content", "words"), [(b"no", "is not an MCAP file"), (None, "no such file")])
def test_repair_rejects_other_files(
    tmp_path: Path, content: bytes | None, words: str, terminal: Terminal
) -> None:
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    assert terminal("repair", str(path)) == 4
    assert words in terminal.err
    assert len(list(tmp_path.iterdir())) == (content is not None)
