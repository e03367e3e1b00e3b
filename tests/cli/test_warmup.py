"""`tactflow warmup`: what it compiles, and that a run then finds everything."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tactflow.cli.main import main

RUN = """
import sys
from tactflow.cli.main import main
from tactflow.vision import compiled
sinks = "sinks={jsonl: {path: out.jsonl}}"
code = main(["run", "--quiet", "--source", "sim:press?frames=60", "--set", sinks])
kernels = compiled.known()
print(code, sum(one.ready for one in kernels) > 5, [one.name for one in kernels if one.compiled_here])
"""


def python(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cwd / "kept")}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_run_after_it_compiles_nothing(tmp_path: Path) -> None:
    warm = python("-m", "tactflow", "warmup", cwd=tmp_path)
    assert warm.returncode == 0, warm.stderr
    assert warm.stdout == ""
    assert "loops are ready" in warm.stderr
    done = python("-c", RUN, cwd=tmp_path)
    assert done.stdout.strip() == "0 True []", done.stderr


def test_a_wrong_pipeline_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wrong.yaml").write_text("stages: {capture: {sauce: 0}}\n")
    assert main(["warmup", str(tmp_path / "wrong.yaml")]) == 2
    assert "sauce" in capsys.readouterr().err
