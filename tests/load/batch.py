"""What a batch costs, and what survives: processes, a Dask cluster, growing work, kill -9.

    python -m tests.load.batch speed --recordings 200 --data ../shared/data
    python -m tests.load.batch cluster --recordings 200
    python -m tests.load.batch growth --counts 10 100 1000
    python -m tests.load.batch resume --kills 10

Each prints the table that stands in docs/batch.md. Everything is written below a temporary folder.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

FRAMES = 60
"""Of each simulated recording."""
TICKS = os.sysconf("SC_CLK_TCK")
"""Units of processor time in a second, as the system counts it."""
SOONEST = 0.4
"""Part of an undisturbed batch after which its process is killed at the latest, so that most kills find work
under way."""
LIGHT = """
stages:
  capture: {source: "sim:idle", settle: 0}
  preprocess: {rotate: 0, downsample: 8}
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


def watch(command: Sequence[str]) -> Call:
    """Run a command to its end."""
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
    return Call(time.perf_counter() - began, processor, memory, process.returncode)


def batch(pipeline: str, sources: Path, out: Path, *options: str) -> list[str]:
    """The command of a batch."""
    start = [sys.executable, "-m", "tactflow", "batch", pipeline, str(sources), "--out", str(out)]
    return [*start, "--quiet", *options]


def simulated(folder: Path, count: int, frames: int = FRAMES) -> Path:
    """A list of simulated recordings."""
    path = folder / f"sim-{count}.txt"
    path.write_text("".join(f"sim:press?frames={frames}&seed={seed}\n" for seed in range(count)))
    return path


def results(out: Path) -> dict[str, str]:
    """Every file of results -> digest of its bytes."""
    files = [path for path in (out / "results").rglob("*") if path.is_file()]
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print in Markdown."""
    for row in (heads, ["---"] * len(heads), *rows):
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


def speed(args: argparse.Namespace, folder: Path) -> None:
    """One process against several, in turn, and the same work in a plain loop."""
    kinds = {"simulated": simulated(folder, args.recordings)}
    if args.data is not None:
        kinds["real"] = args.data
    rows = []
    for kind, sources in kinds.items():
        walls: dict[str, list[float]] = {}
        for turn in range(args.turns):
            if kind == "simulated":
                call = watch([sys.executable, "-c", LOOP, str(sources), str(folder / f"loop-{turn}")])
                walls.setdefault("plain loop", []).append(call.wall)
            for workers in ("1", "2"):
                out = folder / f"{kind}-{workers}-{turn}"
                call = watch(batch("default", sources, out, "--workers", workers))
                walls.setdefault(f"{workers} workers", []).append(call.wall)
        tried = (folder / f"{kind}-1-0" / "ledger" / "1-of-1.jsonl").read_bytes().split(b"\n")
        count = sum(1 for line in tried if line)
        one = statistics.median(walls["1 workers"])
        for name, seen in walls.items():
            wall = statistics.median(seen)
            rows.append([kind, count, name, f"{wall:.1f}", f"{1000 * wall / count:.0f}", f"{one / wall:.2f}"])
    table(["recordings", "number", "by", "wall, s", "a recording, ms", "times as fast"], rows)


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
    """Serial, processes and a Dask cluster of which one worker is killed: the same bytes."""
    sources = simulated(folder, args.recordings)
    rows, seen = [], []
    for name, options in (("1 process", ["--workers", "1"]), ("2 processes", ["--workers", "2"])):
        call = watch(batch("default", sources, folder / name, *options))
        rows.append([name, f"{call.wall:.1f}", call.code])
        seen.append(results(folder / name))
    for name, deadly in (("Dask, 2 workers", False), ("Dask, 1 of 2 workers killed", True)):
        out = folder / name
        with cluster(folder / f"cluster-{deadly}") as (address, processes):
            began = time.perf_counter()
            process = subprocess.Popen(batch("default", sources, out, "--scheduler", address))
            while deadly and process.poll() is None:
                if len(list(out.glob("records/*"))) >= args.recordings // 3:
                    processes[-1].send_signal(signal.SIGKILL)
                    break
                time.sleep(0.05)
            code = process.wait()
            rows.append([name, f"{time.perf_counter() - began:.1f}", code])
        seen.append(results(out))
    for row, found in zip(rows, seen, strict=True):
        row += [len(found), "yes" if found == seen[0] else "no"]
    table(["by", "wall, s", "exit code", "files", "equal to the bit"], rows)


def growth(args: argparse.Namespace, folder: Path) -> None:
    """Time and memory of the process that hands work out, against the number of recordings."""
    pipeline = folder / "light.yaml"
    pipeline.write_text(LIGHT)
    rows = []
    for count in args.counts:
        sources, out = simulated(folder, count, frames=2), folder / f"out-{count}"
        first = watch(batch(str(pipeline), sources, out, "--workers", "2"))
        again = watch(batch(str(pipeline), sources, out, "--workers", "2"))
        sizes = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
        files = sum(1 for path in out.rglob("*") if path.is_file())
        rows.append(
            [
                count,
                f"{first.wall:.1f}",
                f"{first.processor:.1f}",
                f"{first.memory:.0f}",
                f"{again.wall:.1f}",
                f"{again.processor:.1f}",
                f"{again.memory:.0f}",
                files,
                f"{sizes / 1e6:.1f}",
            ]
        )
    heads = ["recordings", "wall, s", "coordinator, CPU-s", "MB", "second call: wall, s", "CPU-s", "MB"]
    table([*heads, "files", "MB written"], rows)


def resume(args: argparse.Namespace, folder: Path) -> None:
    """Kill the coordinator at random moments: what is complete is never done again, and nothing is lost."""
    pipeline = folder / "light.yaml"
    pipeline.write_text(LIGHT)
    sources, out = simulated(folder, args.recordings, frames=20), folder / "out"
    chance = random.Random(args.seed)
    undisturbed = watch(batch(str(pipeline), sources, folder / "undisturbed", "--workers", "2"))
    complete: dict[str, int] = {}
    rows, done_twice = [], 0
    for kill in range(args.kills + 1):
        process = subprocess.Popen(batch(str(pipeline), sources, out, "--workers", "2"))
        if kill < args.kills:
            wait = chance.uniform(0.0, SOONEST * undisturbed.wall)
            time.sleep(wait)
            process.kill()
        code = process.wait()
        # Its workers notice that they are alone.
        time.sleep(1.0)
        now = {path.name: path.stat().st_ino for path in out.glob("records/*.json")}
        again = sum(now.get(name) != inode for name, inode in complete.items())
        done_twice += again
        moment = f"{wait:.1f}" if kill < args.kills else "not"
        left = len(list(out.glob("unfinished/*/*")))
        rows.append([kill + 1, moment, code, len(now) - len(complete), again, left])
        complete = now
    table(["call", "killed after, s", "exit code", "new results", "done again", "unfinished files"], rows)
    same = results(out) == results(folder / "undisturbed")
    print(f"{len(complete)} of {args.recordings} done, {done_twice} twice; as if undisturbed: {same}")


def main() -> None:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("speed", "cluster", "growth", "resume"))
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--data", type=Path, help="a folder of real recordings, for speed")
    parser.add_argument("--turns", type=int, default=2, help="of speed: A B A B")
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tactflow-batch-") as folder:
        {"speed": speed, "cluster": on_cluster, "growth": growth, "resume": resume}[args.what](
            args, Path(folder)
        )


if __name__ == "__main__":
    main()
