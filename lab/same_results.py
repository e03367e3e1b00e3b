"""Compare the results of two checkouts over simulated scenes and real recordings.

    python lab/same_results.py run OUT [--data ../shared/data]     # with this Python's tactflow
    python lab/same_results.py compare BEFORE AFTER

Exit code 1 if anything differs by more than `TOLERANCES`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SCENES = (
    *("press", "bright", "cable", "edge", "ring", "screw"),
    *("two", "slide", "jumps", "dense", "worn"),
)
PIPELINES = ("default", "wedge", "markerless", "classic")
UPRIGHT = {"wedge": [f"stages.preprocess.{key}" for key in ("homography=null", "rotate=90", "downsample=2")]}
"""Pipeline for another camera -> settings for the simulator's pictures."""

TOLERANCES = {"hull": 1.0, "center": 1e-2, "angle": 1e-2, "flow": 1e-2, "position": 1e-3, "status": 0.0}
"""Largest differences: px, degrees; of a hull, the distance of a vertex from the other hull."""


def jobs(data: Path) -> Iterator[tuple[str, str, str, list[str]]]:
    """Yield name, pipeline, source and settings of every run."""
    for pipeline in PIPELINES:
        for scene in SCENES:
            yield f"{pipeline}-{scene}", pipeline, f"sim:{scene}?frames=60", UPRIGHT.get(pipeline, [])
    gels = data / "gels"
    for folder in sorted(path for path in gels.glob("*") if path.is_dir()):
        videos = sorted(path for path in folder.iterdir() if path.suffix in (".avi", ".mp4", ".m4v"))
        source = str(videos[len(videos) // 2]) if videos else str(folder)
        for pipeline in ("default", "markerless"):
            yield f"{pipeline}-{folder.name}", pipeline, source, ["stages.preprocess.rotate=0"]
    for folder, pipeline in (
        *(("wedge_roll", "wedge"), ("wedge_ball", "wedge"), ("wedge_ball", "classic")),
        *(("mini_ball_9mm", "mini_plain"), ("letac/empty", "default")),
    ):
        yield f"{pipeline}-{folder.replace('/', '_')}", pipeline, str(data / folder), []


def run(out: Path, data: Path, frames: int) -> None:
    """Write the messages of every job to OUT/NAME.jsonl."""
    out.mkdir(parents=True, exist_ok=True)
    for name, pipeline, source, settings in jobs(data):
        target = out / f"{name}.jsonl"
        if target.exists():
            continue
        command = [sys.executable, "-m", "tactflow", "run", pipeline, "--source", source, "--quiet"]
        command += ["--max-frames", str(frames), "--jsonl", "-"]
        for setting in (*settings, "sinks.zmq=null", "sinks.view=null", "sinks.jsonl=null"):
            command += ["--set", setting]
        done = subprocess.run(command, capture_output=True, cwd=out, check=False)
        target.write_bytes(done.stdout)
        print(f"{name}: {len(done.stdout.splitlines())} messages, exit {done.returncode}", flush=True)


def numbers(message: dict[str, Any]) -> dict[str, Any]:
    """The numbers of a message that are compared; those that it does not have are missing."""
    contact, flow, markers = (message[key] or {} for key in ("contact", "flow", "markers"))
    found = {key: contact.get(key) for key in ("hull", "center", "angle")} | {"flow": flow.get("mean")}
    statuses = {"tracked": 0, "inferred": 1, "lost": 2}
    found |= {"position": markers.get("position"), "status": [statuses[s] for s in markers.get("status", [])]}
    return {key: value for key, value in found.items() if value is not None}


def difference(key: str, before: Any, after: Any) -> float:
    """How far two values of a number differ at most; infinite if they differ in shape."""
    first, second = (np.asarray(value, np.float32) for value in (before, after))
    if key == "hull":
        return max(
            abs(cv2.pointPolygonTest(border, (float(x), float(y)), True))
            for points, border in ((first, second), (second, first))
            for x, y in points
        )
    if first.shape != second.shape:
        return np.inf
    distance = np.abs(np.subtract(before, after))
    if key == "angle":
        distance = np.minimum(distance, 180 - distance)
    return float(distance.max(initial=0))


def differences(before: dict[str, Any], after: dict[str, Any]) -> Iterator[str]:
    """Describe the differences between two messages of the same frame."""
    if before["seq"] != after["seq"]:
        yield f"seq {before['seq']} and {after['seq']}"
        return
    old, new = numbers(before), numbers(after)
    for key, tolerance in TOLERANCES.items():
        if (key in old) != (key in new):
            yield f"{key} known or not"
        elif key in old and (distance := difference(key, old[key], new[key])) > tolerance:
            yield f"{key} by {distance:.3g}"


def compare(before: Path, after: Path) -> int:
    """Print the differences; return the number of runs that differ."""
    bad = total = 0
    for file in sorted(before.glob("*.jsonl")):
        if not (after / file.name).exists():
            print(f"{file.stem}: not run")
            bad += 1
            continue
        lines = [
            [json.loads(line) for line in (f / file.name).read_text().splitlines()] for f in (before, after)
        ]
        changes: dict[str, list[int]] = {}
        for message, new_message in zip(*lines, strict=False):
            total += 1
            for text in differences(message, new_message):
                changes.setdefault(text, []).append(message["seq"])
        if len(lines[0]) != len(lines[1]):
            changes[f"{len(lines[0])} and {len(lines[1])} messages"] = []
        if changes:
            bad += 1
            print(
                f"{file.stem}: "
                + "; ".join(f"{text} ({seqs[:3]})" for text, seqs in list(changes.items())[:6])
            )
    print(f"{total} messages compared; {bad} runs differ")
    return bad


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    run_parser = commands.add_parser("run")
    run_parser.add_argument("out", type=Path)
    run_parser.add_argument(
        "--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data"
    )
    run_parser.add_argument("--frames", type=int, default=60)
    compare_parser = commands.add_parser("compare")
    compare_parser.add_argument("before", type=Path)
    compare_parser.add_argument("after", type=Path)
    args = parser.parse_args()
    if args.command == "run":
        run(args.out.resolve(), args.data.resolve(), args.frames)
    else:
        sys.exit(bool(compare(args.before, args.after)))
