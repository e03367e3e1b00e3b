"""`tactflow sim` as a user meets it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.cli.main import main
from tactflow.sim import scene_descriptions

Capture = pytest.CaptureFixture[str]


def test_it_writes_frames_and_truth(tmp_path: Path, capsys: Capture) -> None:
    out, truth = tmp_path / "new" / "a.npy", tmp_path / "a.jsonl"
    assert main(["sim", "sim:press?frames=5", "--out", str(out), "--truth", str(truth)]) == 0
    assert np.load(out, mmap_mode="r").shape == (5, 600, 800, 3)
    assert len(truth.read_text().splitlines()) == 5
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "5 frames of press" in printed.err


def test_the_list_names_every_scene_and_every_setting(capsys: Capture) -> None:
    assert main(["sim", "--list"]) == 0
    words = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert {*scene_descriptions(), "noise", "frames", "light"} <= words


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "NAME"),
        (["press"], "--out"),
        (["pres", "--out", "a.npy"], "did you mean press"),
        (["press", "--out", "a.gif"], ".npy"),
        (["press", "--out", "a.npy", "--truth", "a.txt"], ".jsonl"),
        (["press", "--out", "there.npy"], "--overwrite"),
        (["press", "--out", "there.npy/a.npy"], "not a folder"),
        (["press", "--truth", "folder.jsonl"], "is a folder"),
    ],
)
def test_mistakes_are_explained_and_nothing_is_written(
    arguments: list[str],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.npy").write_bytes(b"kept")
    Path("folder.jsonl").mkdir()
    before = sorted(tmp_path.rglob("*"))
    assert main(["sim", *arguments]) == 2
    printed = capsys.readouterr()
    assert complaint in printed.err
    assert "Traceback" not in printed.err
    assert printed.out == ""
    assert sorted(tmp_path.rglob("*")) == before
    assert Path("there.npy").read_bytes() == b"kept"


def test_overwrite_replaces_a_file(tmp_path: Path) -> None:
    out = tmp_path / "a.npy"
    assert main(["sim", "idle?frames=3", "--out", str(out), "--quiet"]) == 0
    assert main(["sim", "idle?frames=2", "--out", str(out), "--quiet", "--overwrite"]) == 0
    assert np.load(out, mmap_mode="r").shape[0] == 2
