"""What a batch costs, and what survives: processes, a Dask cluster, growing work, kill -9.

    python -m benchmarks.load.batch speed
    python -m benchmarks.load.batch speed --data ../shared/data    # real recordings instead
    python -m benchmarks.load.batch cluster
    python -m benchmarks.load.batch growth
    python -m benchmarks.load.batch resume

Each tells what it has done on stderr, and prints the table that stands in docs/batch.md. Everything is
written below a temporary folder. `--recordings` makes it shorter.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FRAMES = 12
"""Of each simulated recording: opening it and writing three tables then takes half of the time."""
LOOPED = 0.25
"""Part of the recordings that the plain loop does too: it has nothing that differs from one to the next."""
TICKS = os.sysconf("SC_CLK_TCK")
"""Units of processor time in a second, as the system counts it."""
LATEST = 0.25
"""Part of an undisturbed batch after which its process is killed at the latest, so that ten kills find work
left."""
WORKERS_END = 1.0
"""Time in which the workers of a killed process have noticed that they are alone, s."""
LIGHT = """
stages:
  capture: {source: "sim:idle", settle: 0}
  preprocess: {rotate: 0}
  difference: {in: {unmarked: preprocess.image}, method: colour}
  hull: {when: touching}
sinks: {}
"""
"""A pipeline that costs next to nothing, to see what the batch costs."""
LOOP = (
    "import sys, tactflow, pathlib\n"
    "for i, source in enumerate(pathlib.Path(sys.argv[1]).read_text().split()):\n"
    "    sink = {'parquet': {'path': f'{sys.argv[2]}/{i}'}}\n"
    "    tactflow.run('default', source=source, settings={'sinks': sink})\n"
)
"""The same work in one process, without a batch."""


@dataclass(frozen=True, slots=True)
class Call:
    """What one call took. wall, processor : s; memory : MB; the last two of its own process alone."""

    wall: float
    processor: float
    memory: float
    code: int


def watch(command: Sequence[str], what: str) -> Call:
    """Run a command to its end, and tell on stderr how long that took."""
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    processor = memory = 0.0
    while process.poll() is None:
        try:
            status = Path(f"/proc/{process.pid}/status").read_text()
            stat = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        peak = [line for line in status.splitlines() if line.startswith("VmHWM")]
        memory = max(memory, float(peak[0].split()[1]) / 1024 if peak else 0.0)
        processor = max(processor, (int(stat[11]) + int(stat[12])) / TICKS)
        time.sleep(0.05)
    call = Call(time.perf_counter() - began, processor, memory, process.returncode)
    tell(f"{what}: {call.wall:.1f} s, exit code {call.code}")
    return call


def tell(words: str) -> None:
    """Say how far it is."""
    print(words, file=sys.stderr, flush=True)


def batch(pipeline: str, sources: Path, out: Path, *options: str) -> list[str]:
    """The command of a batch."""
    start = [sys.executable, "-m", "tactflow", "batch", pipeline, str(sources), "--out", str(out)]
    return [*start, "--quiet", *options]


def simulated(folder: Path, seeds: Sequence[int], frames: int = FRAMES) -> Path:
    """A list of simulated recordings."""
    path = folder / f"sim-{seeds[0]}-{len(seeds)}.txt"
    path.write_text("".join(f"sim:press?frames={frames}&seed={seed}\n" for seed in seeds))
    return path


def tiny(folder: Path, count: int) -> Path:
    """A folder of recordings of two frames of 80 x 60 px, no two of them the same."""
    recordings = folder / f"tiny-{count}"
    recordings.mkdir()
    rng = np.random.default_rng(0)
    for number in range(count):
        np.save(recordings / f"{number}.npy", rng.integers(90, 110, (2, 60, 80, 3), np.uint8))
    return recordings


def results(out: Path) -> dict[str, str]:
    """Every file of results -> digest of its bytes."""
    files = [path for path in (out / "results").rglob("*") if path.is_file()]
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print in Markdown."""
    for row in (heads, ["---"] * len(heads), *rows):
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


def speed(args: argparse.Namespace, folder: Path) -> None:
    """One process against two, in turns on one half of the recordings and then on the other."""
    if args.data is None:
        halves = [range(args.recordings // 2), range(args.recordings // 2, args.recordings)]
        parts = [simulated(folder, half) for half in halves]
    else:
        parts = [args.data]
    walls = {"1 worker": 0.0, "2 workers": 0.0}
    counts, same = 0, True
    for number, part in enumerate(parts):
        outs = []
        for name in walls:
            out = folder / f"{number}-{name}"
            call = watch(batch("default", part, out, "--workers", name[0]), f"part {number + 1}, {name}")
            walls[name] += call.wall
            outs.append(results(out))
        counts += len(list((out / "records").glob("*.json")))
        same = same and outs[0] == outs[1]
    rows = [by(name, counts, wall, walls["1 worker"] / counts) for name, wall in walls.items()]
    if args.data is None:
        few = range(max(1, int(LOOPED * args.recordings)))
        loop = [sys.executable, "-c", LOOP, str(simulated(folder, few)), str(folder / "loop")]
        wall = watch(loop, "the first ones in a plain loop").wall
        rows.insert(0, by("plain loop", len(few), wall, walls["1 worker"] / counts))
    table(["by", "recordings", "wall, s", "a recording, ms", "times as fast as 1 worker"], rows)
    print(f"one worker and two: results equal to the bit: {'yes' if same else 'no'}")


def by(name: str, count: int, wall: float, one: float) -> list[object]:
    """A row of `speed`. one : s that a recording takes with one worker."""
    return [name, count, f"{wall:.1f}", f"{1000 * wall / count:.0f}", f"{one * count / wall:.2f}"]


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and two workers, each a process of its own."""
    folder.mkdir()
    where = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    command += ["--no-dashboard", "--scheduler-file", str(where)]
    started = [subprocess.Popen(command, **quiet)]  # type: ignore[call-overload]
    try:
        while not where.exists():
            time.sleep(0.1)
        command = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(where)]
        command += ["--nthreads", "1", "--no-dashboard", "--local-directory", str(folder), "--no-nanny"]
        started += [subprocess.Popen(command, **quiet) for _ in range(2)]  # type: ignore[call-overload]
        yield json.loads(where.read_text())["address"], started
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def on_cluster(args: argparse.Namespace, folder: Path) -> None:
    """Processes, and a Dask cluster of which one worker is killed: the same bytes."""
    sources = simulated(folder, range(args.recordings))
    call = watch(batch("default", sources, folder / "local", "--workers", "2"), "2 processes")
    first = results(folder / "local")
    rows: list[list[object]] = [["2 processes", f"{call.wall:.1f}", call.code, len(first), "yes"]]
    for name, deadly in (("Dask, 2 workers", False), ("Dask, 1 of 2 workers killed", True)):
        out = folder / name
        with cluster(folder / f"cluster-{deadly}") as (address, processes):
            tell(f"a cluster is there, {name}")
            began = time.perf_counter()
            process = subprocess.Popen(batch("default", sources, out, "--scheduler", address))
            while deadly and process.poll() is None:
                if len(list(out.glob("records/*.json"))) >= args.recordings // 3:
                    processes[-1].send_signal(signal.SIGKILL)
                    tell("a worker is killed")
                    break
                time.sleep(0.05)
            code, wall = process.wait(), time.perf_counter() - began
            tell(f"{name}: {wall:.1f} s, exit code {code}")
        found = results(out)
        rows.append([name, f"{wall:.1f}", code, len(found), "yes" if found == first else "no"])
    table(["by", "wall, s", "exit code", "files", "equal to the bit"], rows)


def growth(args: argparse.Namespace, folder: Path) -> None:
    """Time and memory of the process that hands work out, against the number of recordings."""
    pipeline = folder / "light.yaml"
    pipeline.write_text(LIGHT)
    rows = []
    for count in args.counts:
        sources, out = tiny(folder, count), folder / f"out-{count}"
        command = batch(str(pipeline), sources, out, "--workers", "2")
        calls = [watch(command, f"{count} recordings"), watch(command, f"{count} recordings again")]
        sizes = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
        files = sum(1 for path in out.rglob("*") if path.is_file())
        cells = [f"{v:.{d}f}" for c in calls for v, d in ((c.wall, 1), (c.processor, 1), (c.memory, 0))]
        rows.append([count, *cells, files, f"{sizes / 1e6:.1f}"])
    heads = ["recordings", "wall, s", "coordinator, CPU-s", "MB", "second call: wall, s", "CPU-s", "MB"]
    table([*heads, "files", "MB written"], rows)


def resume(args: argparse.Namespace, folder: Path) -> None:
    """Kill the coordinator at random moments: what is complete is never done again, and nothing is lost."""
    pipeline = folder / "light.yaml"
    pipeline.write_text(LIGHT)
    sources, out = tiny(folder, args.recordings), folder / "out"
    command = batch(str(pipeline), sources, out, "--workers", "2")
    chance = random.Random(args.seed)
    plain = watch(batch(str(pipeline), sources, folder / "undisturbed", "--workers", "2"), "undisturbed")
    complete: dict[str, int] = {}
    rows, done_twice = [], 0
    for kill in range(args.kills + 1):
        process = subprocess.Popen(command)
        moment = "not"
        if kill < args.kills:
            wait = chance.uniform(0.0, LATEST * plain.wall)
            moment = f"{wait:.1f}"
            time.sleep(wait)
            process.kill()
        code = process.wait()
        time.sleep(WORKERS_END)
        now = {path.name: path.stat().st_ino for path in out.glob("records/*.json")}
        again = sum(now.get(name) != inode for name, inode in complete.items())
        done_twice += again
        left = len(list(out.glob("unfinished/*/*")))
        rows.append([kill + 1, moment, code, len(now) - len(complete), again, left])
        tell(f"call {kill + 1}, killed after {moment} s: {len(now)} of {args.recordings} done")
        complete = now
    table(["call", "killed after, s", "exit code", "new results", "done again", "unfinished files"], rows)
    same = "yes" if results(out) == results(folder / "undisturbed") else "no"
    print(f"{len(complete)} of {args.recordings} done, {done_twice} twice; equal to the undisturbed: {same}")


def main() -> None:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("speed", "cluster", "growth", "resume"))
    parser.add_argument("--recordings", type=int, help="default: 200, of resume 600 tiny ones")
    parser.add_argument("--data", type=Path, help="of speed: a folder of real recordings")
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.recordings = args.recordings or (600 if args.what == "resume" else 200)
    with tempfile.TemporaryDirectory(prefix="tactflow-batch-") as folder:
        {"speed": speed, "cluster": on_cluster, "growth": growth, "resume": resume}[args.what](
            args, Path(folder)
        )


if __name__ == "__main__":
    main()
