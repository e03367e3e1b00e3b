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


def test_a_run_can_be_ended_while_it_compiles(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    command = [
        sys.executable,
        "-m",
        "tactflow",
        "run",
        "--source",
        "sim:press?frames=60",
        "--set",
        "sinks={}",
    ]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None
        while "compiling" not in (line := run.stderr.readline()):
            assert line, "it ended before it compiled"
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE) == 0


def test_a_wrong_pipeline_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wrong.yaml").write_text("stages: {capture: {sauce: 0}}\n")
    assert main(["warmup", str(tmp_path / "wrong.yaml")]) == 2
    assert "sauce" in capsys.readouterr().err
