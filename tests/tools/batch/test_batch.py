"""`tactflow batch` does what is missing or has changed, and says what failed."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import tactflow
from tactflow.cli.main import main
from tactflow.tools.batch import command
from tactflow.tools.batch.work import Task
from tests.sources.test_open_source import write_video
from tests.tools.batch.doubles import PIPELINE, InThisProcess, add_stage, recording

REPOSITORY = Path(__file__).resolve().parents[3]


class Call:
    """Calls the command in a folder with a pipeline and recordings, again and again."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capsys = capsys
        self.stderr = ""

    def __call__(self, *words: str, format_: str = "jsonl") -> int:
        self._capsys.readouterr()
        code = main(["batch", "p.yaml", "rec", "--out", "out", "--format", format_, *words])
        self.stderr = self._capsys.readouterr().err
        return code

    def rows(self) -> list[dict[str, object]]:
        lines = (self.folder / "out" / "runs.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines]

    def result(self, number: int) -> Path:
        return self.folder / "out" / str(self.rows()[number]["result"])


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Two recordings of one name, of which nothing is done."""
    (tmp_path / "p.yaml").write_text(PIPELINE)
    recording(tmp_path / "rec" / "a" / "press.npy", brightness=180)
    recording(tmp_path / "rec" / "b" / "press.npy", brightness=220)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "LocalProcesses", InThisProcess)
    return Call(tmp_path, capsys)


def test_every_recording_has_a_result_and_a_second_call_does_nothing(call: Call) -> None:
    assert call() == 0
    assert "2 done now, 0 done before, 0 failed" in call.stderr
    assert [(row["name"], row["status"], row["frames"], row["contacts"]) for row in call.rows()] == [
        ("a/press.npy", "done", 6, 1),
        ("b/press.npy", "done", 6, 1),
    ]
    messages = [json.loads(line) for line in call.result(0).read_text().splitlines()]
    assert [bool(message["contact"]) for message in messages] == [False] * 2 + [True] * 4
    assert not list((call.folder / "out" / "unfinished").iterdir())
    page = (call.folder / "out" / "index.html").read_text()
    pictures = re.findall(r'<img [^>]*src="([^"]*)"', page)
    assert page.count("area, px²") == 2
    shapes = [np.shape(cv2.imread(str(call.folder / "out" / name))) for name in pictures]
    assert shapes == [(48, 64, 3)] * 2
    written = call.result(0).stat().st_mtime_ns
    assert call() == 0
    assert "0 done now, 2 done before, 0 failed" in call.stderr
    assert call.result(0).stat().st_mtime_ns == written


def test_only_what_has_changed_is_done_again(call: Call) -> None:
    call()
    recording(call.folder / "rec" / "b" / "press.npy", brightness=250)
    call()
    assert "1 done now, 1 done before" in call.stderr
    assert "1 outdated (input, pipeline or version changed)" in call.stderr
    call("--set", "stages.hull.min_area=7")
    assert "2 done now, 0 done before" in call.stderr
    recording(call.folder / "rec" / "c.npy")
    call("--set", "stages.hull.min_area=7")
    assert "1 done now, 2 done before" in call.stderr


def test_code_beside_the_pipeline_is_part_of_the_pipeline(call: Call) -> None:
    add_stage(call.folder, "image = image // 2")
    call()
    add_stage(call.folder, "image = image // 3 ")
    call()
    assert "2 outdated (input, pipeline or version changed)" in call.stderr


DAMAGES: dict[str, Callable[[Path, Path], object]] = {
    "truncated": lambda result, _: os.truncate(result, 100),
    "no result": lambda result, _: result.unlink(),
    "no record": lambda _, record: record.unlink(),
    "damaged record": lambda _, record: record.write_text('{"recording": "cut o'),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_result_that_is_not_as_it_was_written_is_made_again(call: Call, damage: str) -> None:
    call()
    path = call.result(1)
    whole = path.read_bytes()
    DAMAGES[damage](path, call.folder / "out" / "records" / f"{path.stem}.json")
    assert call() == 0
    assert "1 done now, 1 done before" in call.stderr
    assert path.read_bytes() == whole


def test_tables_are_whole_only_with_all_their_parts(call: Call) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow: pip install 'tactflow[parquet]'")
    assert call(format_="parquet") == 0
    runs = pq.read_table(call.folder / "out" / "runs.parquet").to_pylist()
    assert [(row["name"], row["touching_frames"]) for row in runs] == [("a/press.npy", 4), ("b/press.npy", 4)]
    tables = call.folder / "out" / runs[1]["result"]
    assert pq.read_table(tables / "frames")["seq"].to_pylist() == list(range(6))
    next(tables.rglob("*.parquet")).unlink()
    call(format_="parquet")
    assert "1 done now, 1 done before" in call.stderr
    assert len(list(tables.rglob("*.parquet"))) == 3


def test_without_the_package_of_parquet_a_batch_writes_csv(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["batch", "p.yaml", "rec", "--out", "out"]) == 0
    out = call.folder / "out"
    with (out / "runs.csv").open(newline="") as file:
        runs = list(csv.DictReader(file))
    assert [(run["name"], run["touching_frames"]) for run in runs] == [
        ("a/press.npy", "4"),
        ("b/press.npy", "4"),
    ]
    with (out / runs[1]["result"]).open(newline="") as file:
        areas = [row["contact.area [px^2]"] for row in csv.DictReader(file)]
    assert [area != "" for area in areas] == [False] * 2 + [True] * 4
    assert call(format_="parquet") == 2
    assert "pip install 'tactflow[parquet]'; or use --format csv or jsonl" in call.stderr


def test_one_that_fails_stops_no_other_and_is_tried_again(call: Call) -> None:
    whole = call.folder / "rec" / "a" / "press.npy"
    whole.write_bytes(b"<no array>")
    assert call() == 3
    assert call.stderr.count("failed: a/press.npy: capture") == 1
    assert [row["status"] for row in call.rows()] == ["failed", "done"]
    page = (call.folder / "out" / "index.html").read_text()
    assert page.index("<td>a/press.npy") < page.index("<td>b/press.npy")
    assert "not a .npy file" in page
    recording(whole)
    assert call() == 0
    assert "1 done now, 1 done before, 0 failed" in call.stderr


def test_one_signal_finishes_running_recordings_and_leaves_the_rest(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit = InThisProcess.submit

    def interrupted(self: InThisProcess, task: Task) -> object:
        signal.raise_signal(signal.SIGINT)
        return submit(self, task)

    with monkeypatch.context() as patched:
        patched.setattr(InThisProcess, "submit", interrupted)
        patched.setattr(InThisProcess, "slots", 1)
        assert call() == 130
    assert "1 not done: run the command again to continue\nended early: interrupted" in call.stderr
    assert call() == 0
    assert "1 done now, 1 done before" in call.stderr


def test_a_full_disk_ends_the_batch_and_loses_nothing(call: Call) -> None:
    full = "if (HERE / 'full').exists():\n    raise OSError(errno.ENOSPC, 'No space left on device')"
    add_stage(call.folder, full)
    assert call() == 0
    (call.folder / "full").touch()
    recording(call.folder / "rec" / "c.npy")
    assert call() == 3
    assert "ended early: the disk is full" in call.stderr
    (call.folder / "full").unlink()
    assert call() == 0
    assert "1 done now, 2 done before" in call.stderr


def test_a_warning_is_reported_at_the_end_and_on_the_page(call: Call) -> None:
    film = call.folder / "rec" / "film.avi"
    scene = tactflow.open_scene("press")
    write_video(film, np.stack([scene.frame(index) for index in range(6)]))
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    assert call() == 0
    assert "1 done with warnings: " in call.stderr
    assert "before its stated end; the file may be damaged; the table of runs has all" in call.stderr
    assert "the file may be damaged" in (call.folder / "out" / "index.html").read_text()


def test_shards_divide_the_work_and_share_the_table(call: Call) -> None:
    assert call("--shard", "2/2") == 0
    assert [row["status"] for row in call.rows()] == ["not done", "done"]
    assert call("--shard", "1/2") == 0
    assert [row["status"] for row in call.rows()] == ["done", "done"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
def test_two_calls_do_not_work_in_one_folder_but_two_shards_do(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit = InThisProcess.submit
    codes: list[int] = []

    def meanwhile(self: InThisProcess, task: Task) -> object:
        if not codes:
            codes.append(main(["batch", "p.yaml", "rec", "--out", "out", "--format", "jsonl"]))
            codes.append(
                main(["batch", "p.yaml", "rec", "--out", "out", "--format", "jsonl", "--shard", "2/2"])
            )
        return submit(self, task)

    monkeypatch.setattr(InThisProcess, "submit", meanwhile)
    assert call() == 0
    assert codes == [2, 0]
    assert "another tactflow batch is using it" in call.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["p.yaml", "nothing", "--out", "o"], "nothing: no such file or folder"),
        (["p.yaml", "--out", "o"], "there are no recordings"),
        (["q.yaml", "rec", "--out", "o"], "there is no file q.yaml"),
        (["p.yaml", "rec", "--out", "p.yaml"], "is not writable"),
        (["p.yaml", "rec", "--out", "o", "--shard", "3/2"], "required I/N"),
    ],
)
def test_a_wrong_command_line_starts_nothing(
    call: Call, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["batch", *words, "--format", "jsonl"]) == 2
    assert message in capsys.readouterr().err
    assert not (call.folder / "o").exists()
