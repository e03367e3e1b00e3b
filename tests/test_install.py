"""The wheel, installed where there is no checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import numpy
import pytest

from tactflow.vision import compiled

REPOSITORY = Path(__file__).resolve().parents[1]

PIPELINE = """
stages: {capture: {source: sim:unmarked}, preprocess: {downsample: 2}}
sinks: {jsonl: {path: out.jsonl}}
"""

RUN = """
from tactflow.cli.main import main
from tactflow.vision import compiled
code = main(["run", "p.yaml", "--quiet", "--max-frames", "30"])
import tactflow.stages.preprocess
print(tactflow.stages.preprocess.__file__)
print(code, compiled.are_compiled())
main(["stages"])
main(["check", "mini"])
"""


def command(*arguments: str | Path, cwd: Path) -> str:
    """Run a command that must succeed; what it says."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(
        [str(a) for a in arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def modules() -> set[str]:
    """Where the wheel holds each Python file of the package."""
    folders = {"src/tactflow": "tactflow", "stages": "tactflow/stages", "sinks": "tactflow/sinks"}
    return {
        f"{inside}/{file.relative_to(REPOSITORY / folder).as_posix()}"
        for folder, inside in folders.items()
        for file in (REPOSITORY / folder).rglob("*.py")
    }


@pytest.mark.timeout(3600)
def test_the_wheel_runs_in_a_fresh_environment_with_its_loops_compiled(tmp_path: Path) -> None:
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", "--quiet")
    command(
        *(*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path, REPOSITORY),
        cwd=tmp_path,
    )
    (wheel,) = tmp_path.glob("tactflow-*.whl")
    assert modules() <= set(zipfile.ZipFile(wheel).namelist())
    venv.create(tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    command(*pip, "--python", python, "install", "--no-deps", wheel, cwd=tmp_path)
    (packages,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    # What the package needs; its own files of this checkout are not among them.
    (packages / "needed.pth").write_text(f"{Path(numpy.__file__).parents[1]}\n")
    program = tmp_path / "venv" / "bin" / "tactflow"
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "p.yaml").write_text(PIPELINE)
    # Without a C compiler the loops are in NumPy, here as in this checkout.
    said = r"\d+ loops are ready" if compiled.are_compiled() else "loops run in NumPy"
    assert re.search(said, command(program, "warmup", "p.yaml", cwd=empty))
    where, *lines = command(python, "-c", RUN, cwd=empty).splitlines()
    assert str(tmp_path / "venv") in where
    assert any(line.startswith("hull") for line in lines)
    assert f"0 {compiled.are_compiled()}" in lines
    assert any("mini.yaml: OK" in line for line in lines)
    assert len((empty / "out.jsonl").read_text().splitlines()) == 30
