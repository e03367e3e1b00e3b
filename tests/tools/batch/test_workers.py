"""Workers: processes that die, are interrupted or lose their parent, and a Dask cluster."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactflow.cli.main import main
from tactflow.tools.batch import workers
from tests.clock import PATIENCE, until
from tests.tools.batch.doubles import add_stage, recording

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="kills processes by signals")

MORTAL = """
level = int(image[0, 0, 0])
if level == 1 or (level == 2 and not (HERE / "died").exists()):
    (HERE / "died").touch()
    os.kill(os.getpid(), signal.SIGKILL)
if level == 3:
    (HERE / f"pid-{os.getpid()}").touch()
    time.sleep(600)
"""
"""A stage that kills its process at level 1, does it once at level 2, and never returns at level 3."""
LEVELS = {"deadly": 1, "unlucky": 2, "endless": 3, "a": 60, "b": 60}


def batch(*words: str) -> list[str]:
    return ["batch", "p.yaml", *words, "--out", "out", "--format", "jsonl"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a pipeline of such a stage, and a recording for each level; the current one."""
    add_stage(tmp_path, MORTAL)
    for name, level in LEVELS.items():
        np.save(tmp_path / f"{name}.npy", np.full((4, 48, 64, 3), level, np.uint8))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def statuses(folder: Path) -> dict[str, str]:
    rows = [json.loads(line) for line in (folder / "out" / "runs.jsonl").read_text().splitlines()]
    return {row["name"].removesuffix(".npy"): row["status"] for row in rows}


def test_a_recording_that_kills_its_worker_fails_and_the_others_are_done(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(batch("a.npy", "deadly.npy", "unlucky.npy", "b.npy", "--workers", "2")) == 3
    assert statuses(folder) == {"a": "done", "deadly": "failed", "unlucky": "done", "b": "done"}
    assert "failed: deadly.npy: killed its worker twice" in capsys.readouterr().err
    assert not list((folder / "out" / "unfinished").iterdir())


def test_python_files_beside_the_recordings_are_not_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("signal", "socket", "struct", "select", "pickle", "array", "cv2"):
        (folder / f"{module}.py").write_text("open('ran', 'w'); raise SystemError('not this one')")
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    command = [sys.executable, "-P", "-m", "tactflow", *batch("a.npy", "b.npy", "--workers", "2")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (folder / "ran").exists()


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A zombie nobody has waited for yet has ended, too.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.fixture
def endless(folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A batch whose worker is in the middle of a recording, and the process of that worker."""
    command = [sys.executable, "-m", "tactflow", *batch("endless.npy", "a.npy", "--workers", "1")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        until(lambda: list(folder.glob("pid-*")))
        (mark,) = folder.glob("pid-*")
        yield process, int(mark.name.removeprefix("pid-"))
    finally:
        process.kill()
        process.communicate()


def test_a_second_signal_aborts_running_recordings(
    folder: Path, endless: tuple[subprocess.Popen[str], int]
) -> None:
    process, worker = endless
    process.send_signal(signal.SIGINT)
    time.sleep(1.0)
    assert process.poll() is None
    until(lambda: process.send_signal(signal.SIGINT) or process.poll() is not None)
    _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "2 not done: run the command again to continue" in stderr
    assert statuses(folder) == {"endless": "not done", "a": "not done"}
    assert not is_running(worker)


def test_workers_end_with_the_process_that_started_them(
    endless: tuple[subprocess.Popen[str], int],
) -> None:
    process, worker = endless
    process.kill()
    until(lambda: not is_running(worker))


@pytest.fixture
def scheduler(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A Dask cluster in this process."""
    distributed = pytest.importorskip("distributed", reason="needs Dask: pip install 'tactflow[dask]'")
    monkeypatch.setattr(workers, "CONNECT_SECONDS", PATIENCE)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster


@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_does_the_same_work(folder: Path, scheduler: Any) -> None:
    (folder / "b.npy").write_bytes(b"no array")
    recording(folder / "press.npy")
    words = batch("press.npy", "b.npy", "a.npy")
    assert main([*words, "--scheduler", scheduler.scheduler_address]) == 3
    assert statuses(folder) == {"press": "done", "b": "failed", "a": "done"}
    here = {path.name: path.read_bytes() for path in (folder / "out" / "results").iterdir()}
    assert main([*words[:-4], "--out", "other", "--format", "jsonl", "--workers", "1"]) == 3
    assert {path.name: path.read_bytes() for path in (folder / "other" / "results").iterdir()} == here


def test_a_scheduler_that_does_not_answer_is_a_mistake_of_the_command_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed", reason="needs Dask: pip install 'tactflow[dask]'")
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 0.3)
    for address in ("tcp://127.0.0.1:9", "no address"):
        assert main([*batch("a.npy"), "--scheduler", address]) == 2
        assert "no Dask scheduler answers" in capsys.readouterr().err
    assert not (folder / "out" / "runs.jsonl").exists()
