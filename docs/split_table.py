"""The table of batch.md: by how much the numbers of a recording that was cut differ from those of the whole.

    python docs/split_table.py ["SOURCE=>PIPELINE" ...]

Parts of 60 frames, with different numbers of frames before each. Takes two minutes on a quiet machine.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import orjson

from tactflow.batch.folder import Folder
from tactflow.batch.recordings import find_recordings
from tactflow.batch.run import resolved
from tactflow.batch.task import Part, Task
from tactflow.batch.work import scratch_name, work
from tactflow.config.shipped import find_pipeline

FRAMES = 60
"""Of a part: a second."""
OVERLAPS = (0, 10, 30, 60)
"""Frames before a part that stages see."""
SOURCES = ("sim:press?frames=240", "sim:slide?frames=240", "sim:jumps?frames=240")


def lines(path: Path) -> list[dict[str, Any]]:
    """The messages of a file."""
    return [orjson.loads(line) for line in path.read_bytes().splitlines()]


def whole(task: Task) -> list[dict[str, Any]]:
    """What the pipeline says of the whole recording."""
    outcome = work(task)
    if outcome.result is None:
        raise SystemExit(f"{outcome.recording}: {outcome.error}")
    return lines(Path(task.folder, "results", outcome.result))


def in_parts(task: Task, frames: int, overlap: int) -> list[dict[str, Any]]:
    """What it says of the parts, one after the other."""
    found = []
    for number, first in enumerate(range(0, frames, FRAMES)):
        part = replace(task, part=Part(number, max(0, first - overlap), first, first + FRAMES))
        outcome = work(part)
        if outcome.status != "done":
            raise SystemExit(f"{outcome.recording}: {outcome.error}")
        found += lines(Path(task.scratch, scratch_name(part)))
    return found


def contact(message: dict[str, Any], key: str) -> Any:
    """A value of the contact, or None."""
    return (message.get("contact") or {}).get(key)


def apart(one: Any, other: Any) -> float | None:
    """Distance of two points, or None where one is missing."""
    return None if one is None or other is None else math.dist(one, other)


def largest(values: Iterator[float | None]) -> str:
    """The largest difference."""
    found = [value for value in values if value is not None]
    return f"{max(found):.2g}" if found else "-"


def row(name: str, overlap: int, one: list[dict[str, Any]], other: list[dict[str, Any]]) -> str:
    """A line of the table."""
    pairs = list(zip(one, other, strict=True))
    same = 100 * sum(a == b for a, b in pairs) / len(pairs)
    only = sum((a["contact"] is None) != (b["contact"] is None) for a, b in pairs)
    centers = largest(apart(contact(a, "center"), contact(b, "center")) for a, b in pairs)
    flows = largest(
        apart((a.get("flow") or {}).get("mean"), (b.get("flow") or {}).get("mean")) for a, b in pairs
    )
    dots = largest(
        apart(a_dot, b_dot) for a, b in pairs for a_dot, b_dot in zip(positions(a), positions(b), strict=True)
    )
    return f"| {name} | {overlap} | {same:.0f} % | {only} | {centers} | {flows} | {dots} |"


def positions(message: dict[str, Any]) -> list[list[float]]:
    """Where the dots are."""
    found: list[list[float]] = (message.get("markers") or {"position": []})["position"]
    return found


def rows(named: str) -> Iterator[str]:
    """The lines of one recording."""
    source, _, pipeline = named.partition("=>")
    (recording,) = find_recordings([source])
    request = resolved(find_pipeline(pipeline or "default"), [], None, "jsonl")
    with tempfile.TemporaryDirectory() as place, Folder(Path(place)).claimed("1-of-1") as scratch:
        task = Task(recording, request, "jsonl", place, str(scratch))
        one = whole(task)
        for overlap in OVERLAPS:
            yield row(recording.name, overlap, one, in_parts(task, len(one), overlap))


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    print("| recording | frames before | equal to the bit | contact in one only | centre, px | flow | dots |")
    print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    for named in sys.argv[1:] or SOURCES:
        for line in rows(named):
            print(line, flush=True)


if __name__ == "__main__":
    main()
