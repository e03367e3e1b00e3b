"""What skipping saves on real recordings, and whether it changes a result.

    python benchmarks/skipping.py [--data ../shared/data] [--plot docs/skipping.png] [NAME ...]

Every recording runs with skipping and without, a few frames each in turn, on one core. A frame at rest is one
without a contact in the run that skips nothing; sensors with fewer than 20 of them are left out. Exit code 1
if a contact begins or ends late by more than one frame, or a number is off for longer than that.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np

import tactflow
from tactflow.bench.judge import LARGE
from tactflow.bench.lockstep import LockstepPipeline, TimedResult
from tactflow.bench.timing import quiet
from tactflow.cli.terminal import show, table
from tactflow.report import figure
from tactflow.sources import open_source

SENSORS = (
    *((name, "default", f"gels/{name}/*.*") for name in ("franka_mini", "seu_a", "sts_640", "sts_torque160")),
    ("handmade_dots", "default", "gels/handmade_dots/*.*"),
    ("tactip_video", "default", "gels/tactip_video"),
    ("letac", "default", "letac/empty"),
    ("wedge_grip", "markerless", "wedge_grip/*.avi"),
    ("wedge_grasp", "markerless", "wedge_grasp/*.avi"),
)
"""Name, pipeline, and recordings in the folder of recordings."""
FEWEST = 20
"""Frames at rest of a sensor."""
TOLERANCE = {"dots": 0.05, "center": 0.5, "flow": 0.05}
"""Largest differences of published numbers, px, as the schema of the message states them."""
LATE = 1
"""Frames for which a contact may begin or end late, or a number be off."""
REPEATED, GLANCED, FULL = "repeated", "glanced at", "in full"


def depth(result: TimedResult) -> str:
    """What was done with a frame."""
    reasons = result.skipped
    if "image" in reasons:
        return REPEATED
    return GLANCED if "at_rest" in reasons.values() else FULL


def numbers(result: TimedResult) -> dict[str, np.ndarray]:
    """The published numbers that are compared, px."""
    found = {}
    if result.markers is not None:
        found["dots"] = result.markers.position
    if result.contact is not None:
        found["center"] = np.asarray(result.contact.center)
    if result.flow is not None and result.flow.mean is not None:
        found["flow"] = np.asarray(result.flow.mean)
    return found


def off(skipping: TimedResult, fresh: TimedResult) -> set[str]:
    """Names of the numbers that differ by more than their tolerance."""
    ours, theirs = numbers(skipping), numbers(fresh)
    return {
        name
        for name in ours.keys() & theirs.keys()
        if ours[name].shape != theirs[name].shape
        or np.abs(ours[name] - theirs[name]).max(initial=0) > TOLERANCE[name]
    }


def run_both(pipeline: str, source: str) -> Iterator[tuple[TimedResult, TimedResult]]:
    """The results of each frame, with skipping and without."""
    with closing(open_source(source)) as reader:
        first = reader.peek()
    halved = first is not None and max(first[0].shape) > LARGE
    settings = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 2 if halved else 1}
    loaded = tactflow.load(pipeline, source=source, settings=settings)
    with ExitStack() as stack:
        stack.enter_context(quiet())
        ours, fresh = (
            stack.enter_context(closing(LockstepPipeline(replace(loaded, skipping=on))))
            for on in (True, False)
        )
        while results := ours.block():
            yield from zip(results, fresh.block(), strict=True)


class Tally:
    """What was found on the recordings of one sensor."""

    def __init__(self) -> None:
        self.frames = self.rest = self.differ = self.late = self.off = 0
        self.depths: dict[str, int] = defaultdict(int)
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def add(self, pairs: list[tuple[TimedResult, TimedResult]]) -> None:
        """Take in one recording."""
        wrong, stale = 0, dict.fromkeys(TOLERANCE, 0)
        for skipping, fresh in pairs:
            touches = fresh.contact is not None
            wrong = wrong + 1 if (skipping.contact is not None) != touches else 0
            differing = off(skipping, fresh)
            stale = {name: count + 1 if name in differing else 0 for name, count in stale.items()}
            self.differ += wrong > 0
            self.late += wrong > LATE
            self.off += max(stale.values()) > LATE
            if fresh.frame.reference:
                continue
            self.frames += 1
            self.seconds["skipping"].append(skipping.cpu_s)
            self.seconds["fresh"].append(fresh.cpu_s)
            kind = depth(skipping)
            self.seconds["contact" if touches else kind].append(skipping.cpu_s)
            if not touches:
                self.rest += 1
                self.depths[kind] += 1

    def row(self, name: str) -> tuple[str, ...]:
        """For the table."""

        def cost(kind: str) -> str:
            if not self.seconds[kind] or not self.seconds["contact"]:
                return "-"
            return f"{np.median(self.seconds[kind]) / np.median(self.seconds['contact']):.2f}"

        shares = [f"{self.depths[kind] / max(self.rest, 1):.0%}" for kind in (REPEATED, GLANCED)]
        whole = f"{sum(self.seconds['skipping']) / max(sum(self.seconds['fresh']), 1e-9):.2f}"
        counts = [str(count) for count in (self.differ, self.late, self.off)]
        return (
            name,
            str(self.frames),
            str(self.rest),
            *shares,
            cost(REPEATED),
            cost(GLANCED),
            whole,
            *counts,
        )


def plot(pairs: list[tuple[TimedResult, TimedResult]], path: Path) -> None:
    """Draw the cost of each frame along a recording, beside what happens in it."""
    pairs = [pair for pair in pairs if not pair[1].frame.reference]
    seconds = [fresh.t for _, fresh in pairs]
    drawing, (cost, happens) = figure(rows=2, size=(8, 4.5), sharex=True)
    for place, label in ((1, "skipping: false"), (0, "skipping: true")):
        cost.step(seconds, [1e3 * pair[place].cpu_s for pair in pairs], where="mid", label=label)
    cost.set(ylabel="CPU of a frame, ms", ylim=(0, None))
    moved = [
        np.abs(fresh.markers.position - fresh.markers.origin).max() for _, fresh in pairs if fresh.markers
    ]
    if moved:
        happens.plot(seconds, moved, label="largest shift of a dot, px")
    area = [fresh.contact.area / 1000 if fresh.contact else 0 for _, fresh in pairs]
    happens.plot(seconds, area, label="area of the contact, 1000 px²")
    happens.set(xlabel="s")
    for axis in (cost, happens):
        axis.legend()
    drawing.savefig(path, dpi=100)


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description="What skipping saves on real recordings.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only paths that hold one of these")
    root = Path(__file__).resolve().parents[2]
    parser.add_argument("--data", type=Path, default=root / "shared" / "data")
    parser.add_argument("--every", type=int, default=1, help="one recording of so many")
    parser.add_argument("--plot", type=Path, help="picture of the last recording")
    args = parser.parse_args()
    logging.getLogger("tactflow").setLevel(logging.ERROR)
    heads = ("sensor", "frames", "at rest", REPEATED, GLANCED, "cost repeated", "glanced", "whole")
    rows, bad = [(*heads, "decisions differ", "late", "off")], 0
    for name, pipeline, pattern in SENSORS:
        tally, pairs = Tally(), []
        for source in sorted(args.data.glob(pattern))[:: args.every]:
            if args.names and not any(part in str(source) for part in args.names):
                continue
            pairs = list(run_both(pipeline, str(source)))
            tally.add(pairs)
        if tally.rest >= FEWEST:
            rows.append(tally.row(name))
            bad += tally.late + tally.off
        if args.plot is not None and pairs:
            plot(pairs, args.plot)
    show(table(rows))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
