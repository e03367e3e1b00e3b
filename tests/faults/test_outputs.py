"""Faults of what sinks write to: what was written before stays, and the run says what is missing."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

from tactflow.cli.main import main
from tactflow.engine.run import Runner
from tactflow.outputs import locked_folder
from tests.faults.outputs import KINDS, settings_of
from tests.faults.rig import FRAMES, At, Seen, array, fill, run, small_disk, write_pipeline

WRITES = ("jsonl", "csv", "images", "video .avi", "record", "parquet")
THEIRS = "somebody else's"


def _remove(output: Path) -> None:
    output.rename(output.with_name("moved-away"))


def _replace(output: Path) -> None:
    other = output.with_name("other")
    other.write_text(THEIRS)
    other.replace(output)


IN_MID_RUN: dict[str, Callable[[Path], None]] = {
    "disk full": lambda output: fill(output.parent),
    "removed": _remove,
    "replaced": _replace,
    "cut to nothing": lambda output: os.truncate(output, 0),
}


def check_promise(kind: str, output: Path, seen: Seen) -> str:
    """What is there; it must be as much as the message says."""
    kept = KINDS[kind].look(output)
    said = re.search(r"the (\d+ (?:lines|pictures|frames)) written before", seen.said)
    assert said is None or kept.startswith(said[1]), f"{seen.said}, but there are {kept}"
    return kept


@pytest.mark.parametrize(
    ("kind", "fault", "code", "said", "kept"),
    [
        (
            "jsonl",
            "disk full",
            3,
            "No space left.* lines written before are complete; free some space",
            "lines",
        ),
        (
            "csv",
            "disk full",
            3,
            "No space left.* lines written before are complete; free some space",
            "lines",
        ),
        ("jsonl", "removed", 3, "was removed by another program", "nothing"),
        ("jsonl", "replaced", 3, "was replaced by another", "theirs"),
        ("jsonl", "cut to nothing", 0, "was cut by another", r"\d\d lines"),
        ("images", "disk full", 3, "No space left.* pictures written", "pictures"),
        ("images", "removed", 3, "cannot be written: No such file", "nothing"),
        ("video .avi", "disk full", 3, "the disk is full; .*; free some space", "can be played"),
        ("video .avi", "removed", 3, "was removed by another program", "nothing"),
        ("video .avi", "replaced", 3, "was replaced by another", "theirs"),
        ("video .avi", "cut to nothing", 3, "it ends before its 120 frames", "can be played"),
        ("video .mkv", "disk full", 3, "the disk is full; ", "can be played"),
        ("video .mp4", "disk full", 3, "the disk is full; ", "can be played"),
        ("record", "disk full", 3, "No space left.*tactflow repair.*; free some space", "frames can be"),
        ("record", "removed", 3, "was removed by another program", "nothing"),
        ("record", "replaced", 3, "was replaced by another", "theirs"),
        ("record", "cut to nothing", 3, "was cut by another program", "not an MCAP file"),
        ("parquet", "disk full", 3, "No space left.* written before", "can be read"),
        ("parquet", "removed", 3, "cannot be written: No such file", "nothing"),
    ],
)
def test_something_happens_to_an_output_in_mid_run(
    kind: str, fault: str, code: int, said: str, kept: str, tmp_path: Path
) -> None:
    with ExitStack() as stack:
        is_full = fault == "disk full"
        place = stack.enter_context(small_disk()) if is_full else tmp_path
        output = place / KINDS[kind].output
        # More rows than fit into what is left of the last page of a file on a full disk, 4 KiB.
        sinks, source = settings_of(kind, output), str(array(tmp_path, 3 * FRAMES if is_full else FRAMES))
        _, seen = run(tmp_path, sinks, lambda _: IN_MID_RUN[fault](output), source=source)
        if fault == "removed":
            left = "something" if output.exists() else "nothing"
        elif fault == "replaced":
            left = "theirs" if output.read_text() == THEIRS else "ours"
        else:
            left = check_promise(kind, output, seen)
    Seen(seen.exit, seen.said, left).must_be(code, said, kept)


@pytest.mark.parametrize("kind", WRITES)
def test_a_folder_that_is_read_only_is_refused_at_the_start(kind: str, tmp_path: Path) -> None:
    with ExitStack() as stack:
        if os.geteuid() == 0:
            # Permissions do not bind an administrator.
            place = stack.enter_context(small_disk("ro"))
        else:
            place = tmp_path / "locked"
            place.mkdir(mode=0o555)
        _, seen = run(tmp_path, settings_of(kind, place / KINDS[kind].output), source=str(array(tmp_path)))
        seen.must_be(3, "Read-only|denied")
        assert not list(place.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="a file is not locked there")
@pytest.mark.parametrize(
    ("kind", "existing"),
    [
        *((kind, "overwrite") for kind in WRITES),
        *(("jsonl", "append"), ("record", None)),
    ],
)
def test_a_second_run_to_the_same_output_is_refused(kind: str, existing: str | None, tmp_path: Path) -> None:
    output, source = tmp_path / KINDS[kind].output, str(array(tmp_path))
    sinks, other = settings_of(kind, output), tmp_path / "other"
    other.mkdir()
    seen: list[Seen] = []

    def run_again(_: Runner) -> None:
        (settings,) = sinks.values()
        again = settings | ({existing: True} if existing else {})
        seen.append(run(other, {kind.split()[0]: again}, source=source)[1])

    _, first = run(tmp_path, sinks, run_again, source=source)
    seen[0].must_be(3, f"{output}: another run is writing to it; end that run, or give another path")
    first.must_be(0)
    assert KINDS[kind].look(output).startswith(f"{FRAMES} ")


@pytest.mark.parametrize("kind", WRITES)
def test_existing_output_is_replaced_only_when_asked(kind: str, tmp_path: Path) -> None:
    output, source = tmp_path / KINDS[kind].output, str(array(tmp_path, 9))
    sinks = settings_of(kind, output)
    for _ in range(2):
        _, seen = run(tmp_path, sinks, source=source)
    seen.must_be(3, "(this file exists|already holds).* set overwrite: true")
    assert KINDS[kind].look(output).startswith("9 ")
    (settings,) = sinks.values()
    _, seen = run(tmp_path, {kind.split()[0]: settings | {"overwrite": True}}, source=source, max_frames=5)
    seen.must_be(0)
    assert KINDS[kind].look(output).startswith("9 " if kind == "images" else "5 ")


@pytest.mark.parametrize("kind", [kind for kind in WRITES if kind != "images"])
def test_a_run_that_another_sink_refuses_leaves_earlier_output_alone(kind: str, tmp_path: Path) -> None:
    output, source = tmp_path / KINDS[kind].output, str(array(tmp_path, 9))
    sinks = settings_of(kind, output)
    run(tmp_path, sinks, source=source)
    ((id_, settings),) = sinks.items()
    refused = tmp_path / "theirs.jsonl"
    refused.write_text("{}\n")
    again = {id_: settings | {"overwrite": True}, "last": {"use": "jsonl", "path": str(refused)}}
    _, seen = run(tmp_path, again, source=source)
    seen.must_be(3, "theirs.jsonl: this file exists")
    assert KINDS[kind].look(output).startswith("9 ")
    refused.unlink()
    _, seen = run(tmp_path, again, source=source, max_frames=5)
    seen.must_be(0)
    assert KINDS[kind].look(output).startswith("5 ")


def test_a_second_export_to_the_same_folder_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av", reason="the extra lerobot is not installed")
    out = tmp_path / "out"
    words = ["export", "lerobot", "sim:press?frames=3", "--pipeline", "mini", "--out", str(out)]
    with locked_folder(out):
        assert main(words) == 3
        assert "another run is writing to it" in capsys.readouterr().err
    assert not out.exists()
    assert main(words) == 0


def test_statistics_that_do_not_fit_the_disk_are_said_and_left_empty(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_pipeline(tmp_path, {"at": {"use": "tests.faults.rig:At"}}, source=str(array(tmp_path)))
    with small_disk() as place:
        report = place / "report.json"
        At.fault = partial(fill, place)
        code = main(["run", str(file), "--quiet", "--stats", str(report)])
        assert report.read_text() == ""
    Seen(code, capsys.readouterr().err).must_be(3, "--stats.*No space")
