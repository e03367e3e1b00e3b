"""Load until it is too much: results, drops, their age and memory against sensors, subscribers and pages.

  python -m benchmarks.load.knee                              writes the section "load" of docs/reliability.md
  python -m benchmarks.load.knee --sensors 1 --rate 60   latency of one sensor at 60 Hz
  python -m benchmarks.load.knee --sensors 4             the same of four at 30 Hz

The subscribers and pages run on the same machine, in a process of their own.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.load.workload import (
    Subscribers,
    children,
    pages,
    running,
    sample,
    write_pipeline,
    write_section,
)

SIZE = (800, 600)
"""Of the pictures, px: the default pipeline halves them."""
RATE = 30.0
"""Of each sensor, frames per second."""
SETTLE = 4.0
"""Time that a run is given after its first results, s. Chosen by hand."""
MEASURED = 15.0
"""Time that each load is measured for, s. Chosen by hand."""
SENSORS = (1, 2, 4, 8, 12, 16, 24)
SUBSCRIBERS = (1, 16, 64, 128, 256)
PAGES = (1, 4, 8, 16)


@dataclass(frozen=True, slots=True)
class Load:
    """What runs at once."""

    sensors: int = 1
    subscribers: int = 1
    pages: int = 0


@dataclass(frozen=True, slots=True)
class Seen:
    """What one load gave.

    results : that arrived at the first subscriber, 0..1; the others are missing from `seq`. shown : pictures
    a second that each page got. p50, p99 : age of a result at the subscribers, ms. oldest : of the last
    second, ms. memory, growth : of all processes, MB, and by how much it grew while it was measured. busy :
    what the machine's processors did, 0..1. rate : of each sensor, frames per second.
    """

    load: Load
    rate: float
    results: float
    shown: float
    p50: float
    p99: float
    oldest: float
    memory: float
    growth: float
    busy: float


def loads() -> Iterator[Load]:
    """All that are measured."""
    yield from (Load(sensors=count) for count in SENSORS)
    yield from (Load(subscribers=count) for count in SUBSCRIBERS[1:])
    yield from (Load(pages=count) for count in PAGES)


def measure(load: Load, port: int, folder: Path, rate: float = RATE) -> Seen:
    """Run one load and look at it."""
    names = [f"s{number}" for number in range(load.sensors)]
    sinks = {"zmq": {"endpoint": f"tcp://127.0.0.1:{port}"}, "view": {"port": port + 1}}
    sensors = {"sensors": {name: {} for name in names}} if load.sensors > 1 else {"sensor": "s0"}
    write_pipeline(folder, SIZE, {"rate": rate}, {"sinks": sinks, **sensors})
    subscribers = Subscribers(f"tcp://127.0.0.1:{port}", load.subscribers, keep=True)
    with ExitStack() as stack:
        process = stack.enter_context(running(folder))
        stack.enter_context(subscribers.reading())
        while len(subscribers.seqs) < load.sensors:
            if process.poll() is not None:
                raise SystemExit((folder / "messages.txt").read_text(encoding="utf-8"))
            time.sleep(0.1)
        pictures = stack.enter_context(pages([port + 1], load.pages))
        time.sleep(SETTLE)
        subscribers.ages.clear()
        subscribers.seqs.clear()
        shown = sum(pictures)
        before, idle = _memory(process.pid), _idle()
        began = time.monotonic()
        time.sleep(MEASURED)
        seconds = time.monotonic() - began
        ages = 1e3 * np.array(subscribers.ages)
        got = [len(seqs) / (seqs[-1] - seqs[0] + 1) for seqs in subscribers.seqs.values()]
        busy = 1 - (_idle() - idle) / (seconds * (os.cpu_count() or 1))
        after = _memory(process.pid)
        shown = sum(pictures) - shown
    last = ages[-max(1, round(rate * load.sensors * load.subscribers)) :]
    p50, p99 = (float(np.percentile(ages, part)) for part in (50, 99))
    per_page = shown / seconds / max(1, load.pages)
    oldest = float(last.max())
    return Seen(load, rate, float(np.mean(got)), per_page, p50, p99, oldest, after, after - before, busy)


def _memory(pid: int) -> float:
    """Of a process and those that it has started, MB."""
    held = [sample(number) for number in [pid, *children(pid)]]
    return sum(one.memory for one in held if one is not None)


def _idle() -> float:
    """Seconds that the processors have been idle for."""
    words = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return int(words[4]) / os.sysconf("SC_CLK_TCK")


def report(found: list[Seen], others: float) -> str:
    """The section of the page.

    others : the machine's load average before.
    """
    rows = [
        f"| {seen.load.sensors} | {seen.load.subscribers} | {seen.load.pages} | {100 * seen.results:.0f} % | "
        f"{seen.shown:.0f} | "
        f"{seen.p50:.1f} | {seen.p99:.0f} | {seen.oldest:.0f} | {seen.memory:.0f} | {seen.growth:+.1f} | "
        f"{100 * seen.busy:.0f} % |"
        for seen in found
    ]
    return "\n".join(
        [
            f"Sensors of {SIZE[0]} x {SIZE[1]} px at {RATE:g} frames a second with a contact that comes and "
            f"goes, each in a process of its own, the default pipeline, on {os.cpu_count()} processors that "
            f"subscribers and pages share; {MEASURED:g} s each (load average of the machine "
            f"before: {others:.1f}). Results that are not there were dropped: a gap in `seq`. Ages "
            "from the moment a frame was due to its result at the subscriber. Too much ends in drops: "
            f"under no load was a result at the end older than {max(seen.oldest for seen in found):.0f} ms, "
            f"nor did memory grow by more than {max(seen.growth for seen in found):.1f} MB.",
            "",
            "| sensors | subscribers | pages | results | pictures a second and page | age, ms: p50 | p99 | "
            "oldest at the end | memory, MB | growth | processors busy |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *rows,
            "",
            "`make load` measures it again.",
        ]
    )


def told(seen: Seen) -> str:
    """One load in words."""
    sensors = "1 sensor" if seen.load.sensors == 1 else f"{seen.load.sensors} sensors"
    return (
        f"{sensors} of {SIZE[0]} x {SIZE[1]} px at {seen.rate:g} frames a second for {MEASURED:g} s: "
        f"{100 * seen.results:.1f} % of the results, age at the subscriber p50 {seen.p50:.2f} ms, "
        f"p99 {seen.p99:.2f} ms; processors {100 * seen.busy:.0f} % busy"
    )


def main() -> None:
    """Measure all loads and write what was seen."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--port", type=int, default=5750)
    parser.add_argument("--sensors", type=int, help="only this many, printed")
    parser.add_argument("--rate", type=float, default=RATE, help="of each of them, frames per second (30)")
    args = parser.parse_args()
    if args.sensors is not None:
        with tempfile.TemporaryDirectory() as folder:
            print(told(measure(Load(sensors=args.sensors), args.port, Path(folder), args.rate)))
        return
    found = []
    others = os.getloadavg()[0]
    for load in loads():
        with tempfile.TemporaryDirectory() as folder:
            found.append(measure(load, args.port, Path(folder)))
        print(found[-1], flush=True)
    write_section("load", report(found, others))


if __name__ == "__main__":
    main()
