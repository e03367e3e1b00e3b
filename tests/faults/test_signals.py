"""Programs that are ended at a random moment, while they write with all sinks: every file is whole."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.clock import PATIENCE, until
from tests.conftest import REPOSITORY
from tests.faults.outputs import KINDS, settings_of
from tests.faults.rig import Seen, array, write_pipeline

WRITES = ("jsonl", "images", "video .avi", "record", "parquet")
"""The sinks that run together. Of the films, only an .avi can be played before it is finished."""
SECONDS = 60.0
"""Length of what is played, s: longer than any test waits before it ends the run."""
FPS = 30.0


def sinks_in(folder: Path) -> dict[str, dict[str, object]]:
    """All sinks, writing to a folder."""
    found: dict[str, dict[str, object]] = {}
    for kind in WRITES:
        found |= settings_of(kind, folder / KINDS[kind].output)
    return found


def ended(number: int, folder: Path, moment: float) -> Seen:
    """End a run some seconds after its first result; exit code and messages."""
    source = array(folder, int(SECONDS * FPS))
    file = write_pipeline(folder, sinks_in(folder), source=str(source), fps=FPS, realtime=True)
    with subprocess.Popen(
        [sys.executable, "-m", "tactflow", "run", str(file), "--quiet"],
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        # The film and the tables, each with a thread of its own, are the last that anything reaches.
        film, tables = (folder / KINDS[kind].output for kind in ("video .avi", "parquet"))
        until(lambda: film.exists() and film.stat().st_size and [*tables.glob("frames/part-*.parquet")])
        time.sleep(moment)
        process.send_signal(number)
        _, said = process.communicate(timeout=PATIENCE)
    lines = [line for line in said.splitlines() if "INFO" not in line and line.startswith("tactflow:")]
    return Seen(process.returncode, "\n".join(lines))


@cache
def ended_once(number: int) -> tuple[Seen, Mapping[str, str]]:
    """One run, ended up to 1 s after its first result, and what each sink left behind."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        seen = ended(number, folder, random.Random(number).uniform(0, 1))
        return seen, {kind: KINDS[kind].look(folder / KINDS[kind].output) for kind in WRITES}


@pytest.mark.parametrize("kind", WRITES)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_sink_has_written_can_be_read_after_the_end(kind: str, number: int) -> None:
    seen, kept = ended_once(number)
    seen.must_be(-number if number == signal.SIGKILL else 0)
    # A number above 0 of lines, pictures or frames.
    assert kept[kind][0] in "123456789"


@pytest.mark.slow
def test_a_sensor_of_two_that_is_killed_is_restarted_and_keeps_what_it_had_written(tmp_path: Path) -> None:
    sinks = {id_: {**sink, "overwrite": True} for id_, sink in sinks_in(tmp_path / "{sensor}").items()}
    file = write_pipeline(tmp_path, sinks, source=str(array(tmp_path, int(6 * FPS))), fps=FPS, realtime=True)
    file.write_text(file.read_text() + "\nsensors: {left: , right: }\n")
    command = [sys.executable, "-m", "tactflow", "run", str(file), "--quiet"]
    left = tmp_path / "left"
    with subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True) as process:
        lines = left / "out.jsonl"
        until(lambda: lines.exists() and lines.read_bytes().count(b"\n") > FPS)
        os.kill(process_of("left", process.pid), signal.SIGKILL)
        _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert "starting again" in said
    assert all(json.loads(line) for line in lines.read_text().splitlines())
    for kind, pattern in (("images", "pictures*"), ("video .avi", "film*.avi"), ("record", "press*.mcap")):
        kept = [KINDS[kind].look(output) for output in sorted(left.glob(pattern))]
        assert len(kept) == 2, kind
        assert all(text[0] in "123456789" for text in kept)


def process_of(sensor: str, supervisor: int) -> int:
    """The child of the supervisor that runs one sensor."""
    for child in Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split():
        words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        if b"--sensor" in words and words[words.index(b"--sensor") + 1] == sensor.encode():
            return int(child)
    raise AssertionError(f"no process runs {sensor}")
