"""`tactflow batch`, with an executor in this process."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import orjson
import pytest

from tactflow.cli import batch as command
from tactflow.cli.main import main, make_parser
from tests.batch.doubles import PIPELINE, InTurn, recording

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a pipeline and two recordings of one name; the current one."""
    (tmp_path / "p.yaml").write_text(PIPELINE)
    recording(tmp_path / "rec" / "a" / "press.npy", brightness=180)
    recording(tmp_path / "rec" / "b" / "press.npy", brightness=220)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "LocalProcesses", lambda _workers: InTurn())
    return tmp_path


def rows(folder: Path) -> list[dict[str, object]]:
    return [orjson.loads(line) for line in (folder / "out" / "runs.jsonl").read_bytes().splitlines()]


def run(*words: str) -> int:
    return main(["batch", "p.yaml", "rec", "--out", "out", "--format", "jsonl", *words])


def test_it_writes_a_table_and_a_page_and_does_nothing_twice(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run() == 0
    found = rows(folder)
    assert [(row["name"], row["status"], row["frames"], row["contacts"]) for row in found] == [
        ("a/press.npy", "done", 6, 1),
        ("b/press.npy", "done", 6, 1),
    ]
    assert found[0]["result"] != found[1]["result"]
    assert all((folder / "out" / str(row["result"])).is_file() for row in found)
    page = (folder / "out" / "index.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 2
    assert page.count('<path class="area"') == 2
    assert "http" not in page.replace('http-equiv="Content', "")
    assert "look at" in capsys.readouterr().err
    assert run() == 0
    assert "2 done before" in capsys.readouterr().err


def test_what_fails_is_listed_with_its_reason_and_the_exit_code_is_3(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "rec" / "a" / "press.npy").write_bytes(b"<no array>")
    assert run() == 3
    assert "failed: a/press.npy: capture" in capsys.readouterr().err
    assert [row["status"] for row in rows(folder)] == ["failed", "done"]
    page = (folder / "out" / "index.html").read_text()
    assert page.index("a/press.npy") < page.index("b/press.npy")
    assert "not a .npy file" in page


def test_what_is_done_with_a_warning_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = folder / "rec" / "film.avi"
    assert main(["sim", "press?frames=6", "--out", str(film), "--quiet"]) == 0
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    assert run() == 0
    told = capsys.readouterr().err
    assert "3 done now" in told
    assert "1 done with warnings: " in told
    assert "of 6 frames; the file may be damaged; the table of runs has all" in told
    page = (folder / "out" / "index.html").read_text()
    # With the name, where it is seen without scrolling sideways.
    row = page[page.index('<tr data-done><td data-value="film.avi">') :]
    assert "the file may be damaged" in row[: row.index("</td>")]


def test_the_last_shard_leaves_all_in_the_table(folder: Path) -> None:
    assert run("--shard", "2/2") == 0
    assert [row["status"] for row in rows(folder)] == ["not done", "done"]
    assert run("--shard", "1/2") == 0
    assert [row["status"] for row in rows(folder)] == ["done", "done"]


def test_two_pipelines_are_compared_with_pictures(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--compare", "p.yaml", "--set", "stages.preprocess.downsample=2") == 0
    told = capsys.readouterr().err
    assert "12 frames; contact in 8 of both" in told
    assert "multiplied by 0.5" in told
    page = (folder / "out" / "compare.html").read_text()
    assert page.count("<section>") == 4
    assert page.count("data:image/jpeg;base64,") == 8
    # The first pipeline is what the table is about.
    assert run("--set", "stages.preprocess.downsample=2") == 0
    assert "2 done before" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["p.yaml", "nothing", "--out", "o"], "nothing: no such file or folder"),
        (["p.yaml", "--out", "o"], "there are no recordings"),
        (["q.yaml", "rec", "--out", "o"], "there is no file q.yaml"),
        (["p.yaml", "rec", "--out", "p.yaml"], "cannot be written into"),
        (["p.yaml", "rec", "--out", "o", "--compare", "p.yaml"], "computes just what"),
        (["p.yaml", "rec", "--out", "o", "--shard", "3/2"], "required I/N"),
    ],
)
def test_a_wrong_command_line_starts_nothing(
    folder: Path, words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["batch", *words, "--format", "jsonl"]) == 2
    assert told in capsys.readouterr().err
    assert not (folder / "o").exists()


def test_parquet_without_pyarrow_says_what_to_install(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "tactflow.batch.runs_table.missing", lambda *_: "Parquet tables need pyarrow: pip install"
    )
    assert main(["batch", "p.yaml", "rec", "--out", str(folder / "o")]) == 2
    assert "pip install; or give --format jsonl" in capsys.readouterr().err


def test_every_command_of_the_page_is_one() -> None:
    page = (REPOSITORY / "docs" / "batch.md").read_text()
    commands = re.findall(r"^tactflow (batch .*?)(?:  +#.*)?$", page, re.MULTILINE)
    assert len(commands) > 5
    parser = make_parser(["batch"])
    for line in commands:
        words = shlex.split(line.replace("$SLURM_ARRAY_TASK_ID", "3"))
        assert parser.parse_args(words).out == Path("out"), line
