"""Measure `tactflow batch` against a plain loop over recordings, and check that results agree.

python benchmarks/batch.py                  # 100 short simulated recordings; two minutes
python benchmarks/batch.py --recordings 1000 --workers 1 2 4
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FRAMES = 12
"""Length of a recording: opening it and writing its tables then takes half of the time."""
LOOP = (
    "import sys, tactflow, pathlib\n"
    "for i, source in enumerate(pathlib.Path(sys.argv[1]).read_text().split()):\n"
    "    sinks = {'parquet': {'path': f'{sys.argv[2]}/{i}'}}\n"
    "    tactflow.run('default', source=source, settings={'sinks': sinks})\n"
)
"""Program that processes the recordings in one process, without a batch."""


def seconds(*arguments: str | Path) -> float:
    """Run Python; return the wall time, s."""
    began = time.perf_counter()
    subprocess.run([sys.executable, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def digest(out: Path) -> str:
    """Digest of all results of a batch."""
    files = sorted(path for path in (out / "results").rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()


def main() -> None:
    """Measure and print a table in Markdown."""
    parser = argparse.ArgumentParser(description="Measure `tactflow batch`.")
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = folder / "sources.txt"
        specs = (f"sim:press?frames={FRAMES}&seed={seed}\n" for seed in range(args.recordings))
        sources.write_text("".join(specs))
        walls = {"plain loop": seconds("-c", LOOP, sources, folder / "loop")}
        digests = set()
        for workers in args.workers:
            out = folder / str(workers)
            command = ("-m", "tactflow", "batch", "default", sources, "--out", out, "--quiet")
            walls[f"{workers} workers"] = seconds(*command, "--workers", str(workers))
            digests.add(digest(out))
    print("| by | wall, s | a recording, ms |\n| --- | --- | --- |")
    for by, wall in walls.items():
        print(f"| {by} | {wall:.1f} | {1e3 * wall / args.recordings:.0f} |")
    print(f"results bit-identical: {'yes' if len(digests) == 1 else 'no'}")


if __name__ == "__main__":
    main()
