"""What skipping saves on real recordings, and whether it changes a result.

    python -m lab.skipping [--data ../shared/data] [NAME ...]

Every recording runs with skipping and without, a few frames each in turn, on one core. A frame at rest is one
without a contact in the run that skips nothing; `far` are those more than 8 frames away from any contact.
Sensors with fewer than 20 at rest are left out. Exit code 1 if a contact begins or ends late by more than one
frame, or a number is off for longer than that.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter, defaultdict
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np

import tactflow
from lab.judges.judge import MAX_WHOLE_SIDE_PX
from tactflow import Result
from tactflow.sources import open_source
from tactflow.system.terminal import show, table
from tactflow.tools.bench.lockstep import LockstepPipeline, TimedResult
from tactflow.tools.bench.timing import quiet

SENSORS = (
    *((name, "default", f"gels/{name}/*.*") for name in ("franka_mini", "seu_a", "sts_640", "sts_torque160")),
    ("handmade_dots", "default", "gels/handmade_dots/*.*"),
    ("tactip_video", "default", "gels/tactip_video"),
    ("letac", "default", "letac/empty"),
    ("wedge_grip", "markerless", "wedge_grip/*.avi"),
    ("wedge_grasp", "markerless", "wedge_grasp/*.avi"),
)
"""Name, pipeline, and recordings in the folder of recordings."""
MIN_REST_FRAMES = 20
"""Frames at rest of a sensor."""
NEIGHBOUR_FRAMES = 8
"""Frames before and after a contact in which the gel is moving already, or still."""
TOLERANCES = {"dots": 0.05, "center": 0.5, "flow": 0.05}
"""Largest differences of published numbers, px, as the schema of the message states them."""
HEADS = ("sensor", "frames", "at rest", "repeated", "glanced at", "far", "cost repeated", "glanced", "whole")

Pairs = list[tuple[TimedResult, TimedResult]]
"""The results of each frame, with skipping and without."""


def depth(result: Result) -> str:
    """What was done with a frame."""
    reasons = result.skipped
    return "repeated" if "image" in reasons else "glanced at" if "at_rest" in reasons.values() else "in full"


def numbers(result: Result) -> dict[str, np.ndarray]:
    """The published numbers that are compared, px."""
    found = {}
    if result.markers is not None:
        found["dots"] = result.markers.position
    if result.contact is not None:
        found["center"] = np.asarray(result.contact.center)
    if result.flow is not None and result.flow.mean is not None:
        found["flow"] = np.asarray(result.flow.mean)
    return found


def differing(skipping: Result, fresh: Result) -> set[str]:
    """What differs: `decision`, or the names of the numbers that do by more than their tolerance."""
    ours, theirs = numbers(skipping), numbers(fresh)
    names = {
        name
        for name in ours.keys() & theirs.keys()
        if ours[name].shape != theirs[name].shape
        or np.abs(ours[name] - theirs[name]).max(initial=0) > TOLERANCES[name]
    }
    return names | ({"decision"} if (skipping.contact is None) != (fresh.contact is None) else set())


def run_both(pipeline: str, source: str) -> Pairs:
    """Run a recording."""
    with closing(open_source(source)) as reader:
        first = reader.peek()
    halved = first is not None and max(first[0].shape) > MAX_WHOLE_SIDE_PX
    settings = {"stages.preprocess.rotate": 0, "stages.preprocess.downsample": 2 if halved else 1}
    loaded = tactflow.load(pipeline, source=source, settings=settings)
    pairs: Pairs = []
    with ExitStack() as stack:
        stack.enter_context(quiet())
        ours, fresh = (
            stack.enter_context(closing(LockstepPipeline(replace(loaded, skipping=on))))
            for on in (True, False)
        )
        while results := ours.block():
            pairs += zip(results, fresh.block(), strict=True)
    return pairs


class Tally:
    """What was found on the recordings of one sensor. counts : of frames. seconds : CPU of each."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def add(self, pairs: Pairs) -> None:
        """Take in one recording."""
        touched = np.array([fresh.contact is not None for _, fresh in pairs], np.uint8)
        near = np.convolve(touched, np.ones(2 * NEIGHBOUR_FRAMES + 1), "same") > 0
        before: set[str] = set()
        for (skipping, fresh), touches, is_near in zip(pairs, touched, near, strict=True):
            differs = differing(skipping, fresh)
            for_long, before = differs & before, differs
            self.counts["differ"] += "decision" in differs
            self.counts["late"] += "decision" in for_long
            self.counts["off"] += bool(for_long - {"decision"})
            if fresh.frame.reference:
                continue
            kind = depth(skipping)
            self.seconds["skipping"].append(skipping.cpu_s)
            self.seconds["fresh"].append(fresh.cpu_s)
            self.seconds["contact" if touches else kind].append(skipping.cpu_s)
            if not touches:
                self.counts.update(("rest", kind))
                self.counts.update(() if is_near else ("far", f"far {kind}"))

    def row(self, name: str) -> tuple[str, ...]:
        """For the table."""
        n, seconds = self.counts, self.seconds
        far = 1 - n["far in full"] / max(n["far"], 1)
        shares = [*(n[kind] / max(n["rest"], 1) for kind in ("repeated", "glanced at")), far]
        contact = np.median(seconds["contact"] or [np.nan])
        costs = [np.median(seconds[kind] or [np.nan]) / contact for kind in ("repeated", "glanced at")]
        costs.append(sum(seconds["skipping"]) / max(sum(seconds["fresh"]), 1e-9))
        return (
            name,
            *(str(count) for count in (len(seconds["fresh"]), n["rest"])),
            *(f"{share:.0%}" for share in shares),
            *("-" if np.isnan(cost) else f"{cost:.2f}" for cost in costs),
            *(str(n[what]) for what in ("differ", "late", "off")),
        )


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description="What skipping saves on real recordings.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only paths that hold one of these")
    root = Path(__file__).resolve().parents[2]
    parser.add_argument("--data", type=Path, default=root / "shared" / "data")
    args = parser.parse_args()
    logging.getLogger("tactflow").setLevel(logging.ERROR)
    rows, bad = [(*HEADS, "decisions differ", "late", "off")], 0
    for name, pipeline, pattern in SENSORS:
        tally = Tally()
        for source in sorted(args.data.glob(pattern)):
            if not args.names or any(part in str(source) for part in args.names):
                tally.add(run_both(pipeline, str(source)))
        if tally.counts["rest"] >= MIN_REST_FRAMES:
            rows.append(tally.row(name))
            bad += tally.counts["late"] + tally.counts["off"]
    show(table(rows))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
