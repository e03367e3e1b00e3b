"""Programs that are ended at a random moment, while they write with all sinks."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from tactflow.system.signals import INTERRUPTED
from tests.clock import PATIENCE, until
from tests.faults.rig import Seen, array, write_pipeline
from tests.faults.sinks import KINDS, settings_of

REPOSITORY = Path(__file__).resolve().parents[2]
WRITES = ("jsonl", "images", "video .avi", "record", "parquet")
"""The sinks that run together. Of the films, only an .avi can be played before it is finished."""
SECONDS = 60.0
"""Length of what is played, s: longer than any test waits before it ends the run."""
FPS = 30.0
STARTING = 3.0
"""Time in which a run starts, with a margin, s; measured 1 to 2 s."""


def start(folder: Path, sinks: Mapping[str, object], *options: str) -> subprocess.Popen[str]:
    """Start a run of its own that plays a recording at its pace."""
    source = array(folder, int(SECONDS * FPS))
    file = write_pipeline(folder, sinks, source=str(source), fps=FPS, realtime=True)
    return subprocess.Popen(
        [sys.executable, "-m", "tactflow", "run", str(file), "--quiet", *options],
        cwd=REPOSITORY,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _ended(number: int, folder: Path, moment: float, *, starting: bool) -> Seen:
    """End a run some seconds after its start, or after its first result; exit code and messages."""
    sinks = {id_: settings for kind in WRITES for id_, settings in _settings(kind, folder).items()}
    with start(folder, sinks) as process:
        if not starting:
            # The film and the tables, each with a thread of its own, are the last that anything reaches.
            film, tables = (folder / KINDS[kind].output for kind in ("video .avi", "parquet"))
            until(lambda: film.exists() and film.stat().st_size and [*tables.glob("frames/part-*.parquet")])
        time.sleep(moment)
        process.send_signal(number)
        _, said = process.communicate(timeout=PATIENCE)
    lines = [line for line in said.splitlines() if "INFO" not in line and line.startswith("tactflow:")]
    return Seen(process.returncode, "\n".join(lines))


def _settings(kind: str, folder: Path) -> dict[str, dict[str, object]]:
    return settings_of(kind, folder / KINDS[kind].output)


@cache
def _ended_once(number: int) -> tuple[Seen, Mapping[str, str]]:
    """One run, ended up to 1 s after its first result, and what each sink left behind."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seen = _ended(number, folder, random.Random(number).uniform(0, 1), starting=False)
        return seen, {kind: KINDS[kind].look(folder / KINDS[kind].output) for kind in WRITES}


def ended(kind: str, number: int, folder: Path) -> Seen:
    """What one sink leaves behind when its run is ended. The sinks of all cases write in one run."""
    del folder
    seen, kept = _ended_once(number)
    return Seen(seen.exit, seen.said, kept[kind])


def ended_often(number: int, times: int, folder: Path) -> Seen:
    """Runs that are ended at random moments, also while they start: what was said and left."""
    moments = random.Random(number)
    outputs = [KINDS[kind].output for kind in WRITES]
    said, early = set(), 0
    for turn in range(times):
        place = folder / str(turn)
        place.mkdir()
        seen = _ended(number, place, moments.uniform(0, 2 * STARTING), starting=True)
        said |= set(filter(None, [seen.said]))
        if number == signal.SIGKILL:
            assert seen.exit == -number
        elif seen.exit != 0:
            # While Python itself starts, the signal ends it.
            early += 1
            assert seen.exit in (-number, INTERRUPTED), seen
            assert [path.name for path in place.iterdir() if path.name in outputs] == []
        for kind in WRITES:
            output = place / KINDS[kind].output
            if output.exists() and kind != "video .avi" and not _is_empty(output):
                KINDS[kind].look(output)
    kept = f"{times} runs left nothing damaged"
    if number == signal.SIGKILL:
        return Seen(-number, "\n".join(said), kept)
    return Seen(0, "\n".join(said), f"{kept}; {early} ended before they had begun")


def _is_empty(output: Path) -> bool:
    return output.is_file() and output.stat().st_size == 0


TWO = """
sensors: {left: , right: }
"""


def restarted(folder: Path) -> Seen:
    """A sensor of two is killed; all sinks may replace what is there when the run begins."""
    source = array(folder, int(6 * FPS))
    sinks: dict[str, dict[str, object]] = {}
    for kind in WRITES:
        for id_, settings in _settings(kind, folder / "{sensor}").items():
            sinks[id_] = settings | {"overwrite": True}
    file = write_pipeline(folder, sinks, source=str(source), fps=FPS, realtime=True)
    file.write_text(file.read_text() + TWO)
    command = [sys.executable, "-m", "tactflow", "run", str(file), "--quiet"]
    with subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.PIPE, text=True) as process:
        lines = folder / "left" / "out.jsonl"
        until(lambda: lines.exists() and lines.read_bytes().count(b"\n") > FPS)
        _kill_sensor(process.pid, "left")
        _, said = process.communicate(timeout=PATIENCE)
    left = folder / "left"
    shots = [KINDS["images"].look(one) for one in sorted(left.glob("pictures*"))]
    films = [KINDS["video .avi"].look(one) for one in sorted(left.glob("film*.avi"))]
    recordings = [KINDS["record"].look(one) for one in sorted(left.glob("press*.mcap"))]
    count = sum(1 for line in lines.read_text().splitlines() if json.loads(line))
    said = "\n".join(line for line in said.splitlines() if line.startswith("tactflow: left"))
    return Seen(
        process.returncode,
        said,
        f"{count} lines; " + "; ".join(" and ".join(x) for x in (shots, films, recordings)),
    )


def _kill_sensor(supervisor: int, sensor: str) -> None:
    """Kill the process of one sensor: the child of the supervisor that was started for it."""
    import os

    for child in Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split():
        words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        if b"--sensor" in words and words[words.index(b"--sensor") + 1] == sensor.encode():
            os.kill(int(child), signal.SIGKILL)
