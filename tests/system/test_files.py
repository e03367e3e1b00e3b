"""Files that appear when they are complete."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tactflow.system.files import completed


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_killed_process_left_is_removed_by_the_next_that_writes_the_same(
    kind: str, tmp_path: Path
) -> None:
    out = tmp_path / "press.npy"
    with completed(out) as left:
        pass
    left.mkdir() if kind == "folder" else left.write_text("half")
    with completed(out) as partial:
        assert os.listdir(tmp_path) == []
        partial.write_text("whole")
    assert os.listdir(tmp_path) == ["press.npy"]
    assert out.read_text() == "whole"


def test_where_nothing_was_written_nothing_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "press.npy"
    out.write_text("before")
    with completed(out):
        pass
    assert os.listdir(tmp_path) == ["press.npy"]
    assert out.read_text() == "before"
