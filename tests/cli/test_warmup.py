"""`tactflow warmup`, and how compiling ends; tests/test_install.py warms up a fresh environment."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.clock import PATIENCE


def test_a_run_can_be_ended_while_it_compiles(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    words = ["run", "--source", "sim:press?frames=60", "--set", "sinks={}"]
    command = [sys.executable, "-m", "tactflow", *words]
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None
        while "compiling" not in (line := run.stderr.readline()):
            assert line, "it ended before it compiled"
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE) == 0
