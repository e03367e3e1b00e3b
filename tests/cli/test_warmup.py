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

HELD = r"""
import time
from pathlib import Path
from tactflow.cli import run
from tactflow.engine.contract import Stage
from tactflow.ports import Image
from tactflow.vision import compiled

sent = Path(__file__).with_name("sent")
wait = f"import pathlib, time\nwhile not pathlib.Path({str(sent)!r}).exists():\n    time.sleep(0.001)\n"
compiled._WORKER = wait + compiled._WORKER
compile_or_read = compiled.Kernel._compile_or_read

begun = []

def compile_and_wait(*args):
    begun.append(args)
    if len(begun) > 1:
        exec(wait)
    return compile_or_read(*args)

compiled.Kernel._compile_or_read = compile_and_wait
stop_at_end_of_input = run._stop_at_end_of_input

def stop_and_go_on(runner):
    stop_at_end_of_input(runner)
    sent.touch()

run._stop_at_end_of_input = stop_and_go_on

class Held(Stage):
    memory = "pure"
    def process(self, image: Image) -> Image:
        return image
"""
"""A module that has no more than one loop compiled until the run has been told to end."""


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc")
@pytest.mark.parametrize("by", ["Ctrl-C", "end of input"])
def test_compiling_and_the_processes_that_help_are_ended(by: str, tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    (tmp_path / "held.py").write_text(HELD)
    settings = ["--set", "sinks={jsonl: {path: out.jsonl}}", "--set", "stages.held={use: './held.py:Held'}"]
    command = [sys.executable, "-m", "tactflow", "run", "--source", "sim:press?frames=60", *settings]
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
            (tmp_path / "sent").touch()
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
