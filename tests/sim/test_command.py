"""`tactflow sim` as a user meets it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.sim import scene_descriptions
from tests.terminal import Terminal


def test_it_writes_frames_and_truth(terminal: Terminal) -> None:
    assert terminal("sim", "sim:press?frames=5", "--out", "new/a.npy", "--truth", "a.jsonl") == 0
    assert np.load("new/a.npy", mmap_mode="r").shape == (5, 600, 800, 3)
    assert len(Path("a.jsonl").read_text().splitlines()) == 5
    assert terminal.out == ""
    assert "5 frames of press" in terminal.err


def test_the_list_names_every_scene_and_every_setting(terminal: Terminal) -> None:
    assert terminal("sim", "--list") == 0
    words = {line.split()[0] for line in terminal.out.splitlines()}
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
    arguments: list[str], complaint: str, terminal: Terminal
) -> None:
    Path("there.npy").write_bytes(b"kept")
    Path("folder.jsonl").mkdir()
    before = sorted(Path().rglob("*"))
    assert terminal("sim", *arguments) == 2
    assert complaint in terminal.err
    assert "Traceback" not in terminal.err
    assert terminal.out == ""
    assert sorted(Path().rglob("*")) == before
    assert Path("there.npy").read_bytes() == b"kept"
