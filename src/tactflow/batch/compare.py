"""Tabulate how the results of two pipelines over the same recordings differ, one row per recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson
from numpy.typing import NDArray

from tactflow.message.columns import frame_columns
from tactflow.report import Table

QUANTITIES = {
    "area, px²": ("contact_area",),
    "centre, px": ("contact_center_x", "contact_center_y"),
    "angle, °": ("contact_angle",),
    "flow, px": ("flow_mean_x", "flow_mean_y"),
}
"""Heading -> columns of the table `frames`; the norm of their difference is compared."""
HALF_TURN = 180.0
"""Period of an axis direction, degrees."""

Frames = Mapping[int, Mapping[str, Any]]
"""seq -> row of the table `frames`: column -> value or None."""


def compare(results: Iterable[tuple[str, Path, Path]]) -> Table:
    """Compare two results of each recording, frame by frame.

    results : name of the recording and the results of both pipelines. Quantities are in pixels of the
    processed frame, so both pipelines should produce frames of the same size.
    """
    columns = ["recording", "frames in both", "contact in both", "in the first only", "in the second only"]
    columns += ["outlines, mean IoU"]
    columns += [f"{name}: {which}" for name in QUANTITIES for which in ("median", "largest")]
    return Table(columns, [[name, *_row(read(first), read(second))] for name, first, second in results])


def read(result: Path) -> Frames:
    """Read the frames of a result, a `.jsonl` file or a folder of Parquet tables."""
    if result.is_dir():
        import pyarrow.parquet as pq  # type: ignore[import-untyped]

        names = ["seq", "contact_hull", *(name for names in QUANTITIES.values() for name in names)]
        return {row["seq"]: row for row in pq.read_table(result / "frames", columns=names).to_pylist()}
    messages = map(orjson.loads, result.read_bytes().splitlines())
    columns = frame_columns()
    return {message["seq"]: {c.name: c.value(message) for c in columns} for message in messages}


def _row(first: Frames, second: Frames) -> list[Any]:
    pairs = [(first[seq], second[seq]) for seq in sorted(first.keys() & second.keys())]
    hulls = [(a["contact_hull"], b["contact_hull"]) for a, b in pairs]
    both = [(a, b) for a, b in hulls if a and b]
    row: list[Any] = [len(pairs), len(both)]
    row += [sum(bool(a and not b) for a, b in hulls)]
    row += [sum(bool(b and not a) for a, b in hulls)]
    row.append(float(np.mean([_overlap(a, b) for a, b in both])) if both else None)
    for names in QUANTITIES.values():
        values = [[[frame[name] for name in names] for frame in pair] for pair in pairs]
        known = np.array([v for v in values if None not in v[0] + v[1]], float).reshape(-1, 2, len(names))
        difference = known[:, 1] - known[:, 0]
        if names[0].endswith("angle"):
            difference = (difference + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2
        norms = np.linalg.norm(difference, axis=1)
        row += [float(np.median(norms)), float(norms.max())] if len(norms) else [None, None]
    return row


def _overlap(first: list[list[float]], second: list[list[float]]) -> float:
    """Intersection over union of two convex outlines."""
    a, b = (np.array(hull, np.float32) for hull in (first, second))
    intersection = float(cv2.intersectConvexConvex(a, b)[0])
    union = _area(a) + _area(b) - intersection
    return intersection / union if union > 0 else 0.0


def _area(hull: NDArray[np.float32]) -> float:
    return float(cv2.contourArea(hull))
