"""`tactflow warmup`, and how compiling ends; tests/test_install.py warms up a fresh environment."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tactflow.cli.main import main
from tests.clock import PATIENCE


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
@pytest.mark.parametrize("by", ["Ctrl-C", "end of input"])
def test_compiling_and_the_processes_that_help_are_ended(by: str, tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    sinks = "sinks={jsonl: {path: out.jsonl}}"
    command = [sys.executable, "-m", "tactflow", "run", "--source", "sim:press?frames=60", "--set", sinks]
    with subprocess.Popen(
        [*command, "--end-with-stdin"],
        cwd=tmp_path,
        env=environment,
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stdin is not None
        assert run.stderr is not None
        line = run.stderr.readline()
        while line and "compiling" not in line:
            line = run.stderr.readline()
        if by == "Ctrl-C":
            run.send_signal(signal.SIGINT)
        else:
            run.stdin.close()
        assert run.wait(PATIENCE) == 0
    # Each process may finish the loop at which it is; the default pipeline has some twenty.
    assert len(list((tmp_path / "kept").rglob("*.nbi"))) < 10
    assert not [path for path in Path("/proc").glob("[0-9]*") if mentions(path, tmp_path)]


def mentions(process: Path, folder: Path) -> bool:
    try:
        return str(folder).encode() in (process / "environ").read_bytes()
    except OSError:
        return False


def test_a_wrong_pipeline_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wrong.yaml").write_text("stages: {capture: {sauce: 0}}\n")
    assert main(["warmup", str(tmp_path / "wrong.yaml")]) == 2
    assert "sauce" in capsys.readouterr().err
