"""Files that appear when they are complete."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from tactflow.system.files import completed

KILLED = """
import os, signal, sys
from pathlib import Path
from tactflow.system.files import completed
with completed(Path(sys.argv[1])) as partial:
    partial.mkdir() if sys.argv[2] == "folder" else partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there, nobody knows which processes are left")
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_killed_process_left_is_removed_by_the_next_that_writes_the_same(
    kind: str, tmp_path: Path
) -> None:
    out, others = tmp_path / "press[1].npy", tmp_path / f".press[1].{platform.node()[:16]}-1.partial.npy"
    others.touch()
    subprocess.run([sys.executable, "-c", KILLED, str(out), kind], check=False)
    assert len(list(tmp_path.iterdir())) == 2
    with completed(out) as partial:
        assert sorted(tmp_path.iterdir()) == [others]
        partial.write_text("whole")
    # Process 1 runs as long as the machine does.
    assert sorted(tmp_path.iterdir()) == sorted([others, out])
    assert out.read_text() == "whole"


def test_where_nothing_was_written_nothing_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "press.npy"
    out.write_text("before")
    with completed(out):
        pass
    assert os.listdir(tmp_path) == ["press.npy"]
    assert out.read_text() == "before"
