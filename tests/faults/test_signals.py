"""A program that is ended at a random moment, while it writes with all sinks: every file can be read."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.clock import PATIENCE, until
from tests.faults.outputs import KINDS, settings_of
from tests.faults.rig import array, write_pipeline
from tests.paths import REPOSITORY

WRITES = ("jsonl", "images", "video .avi", "record", "parquet")
"""The sinks that run together. Of the films, only an .avi can be played before it is finished."""
FRAMES = 1800
"""A minute at 30 Hz: longer than any test waits before it ends the run."""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_what_the_sinks_have_written_can_be_read_after_the_end(number: int, tmp_path: Path) -> None:
    outputs = {kind: tmp_path / KINDS[kind].output for kind in WRITES}
    sinks = {id_: sink for kind in WRITES for id_, sink in settings_of(kind, outputs[kind]).items()}
    file = write_pipeline(tmp_path, sinks, source=str(array(tmp_path, FRAMES)), fps=30.0, realtime=True)
    with subprocess.Popen(
        [sys.executable, "-m", "tactflow", "run", str(file), "--quiet"],
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        # The film and the tables, each with a thread of its own, are the last that anything reaches.
        film, tables = outputs["video .avi"], outputs["parquet"]
        until(lambda: film.exists() and film.stat().st_size and [*tables.glob("frames/part-*.parquet")])
        time.sleep(random.Random(number).uniform(0, 1))
        process.send_signal(number)
        _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == (-number if number == signal.SIGKILL else 0)
    assert not [line for line in stderr.splitlines() if line.startswith("tactflow:") and "INFO" not in line]
    for kind, output in outputs.items():
        # A number above 0 of lines, pictures or frames.
        assert KINDS[kind].look(output)[0] in "123456789", kind
