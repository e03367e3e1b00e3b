"""How the results of two pipelines over the same recordings differ: a table, one row for each recording."""

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
"""Heading -> columns of the table `frames`, of which the length of the difference is taken."""
HALF_TURN = 180.0
"""Degrees after which the direction of an axis is the same again."""

Frames = Mapping[int, Mapping[str, Any]]
"""seq -> row of the table `frames`: column -> value or None."""


def compare(results: Iterable[tuple[str, Path, Path]]) -> Table:
    """Compare two results of each recording, frame by frame.

    results : name of the recording, result of the first pipeline, result of the second. Quantities are in
    pixels of the processed frame, so both pipelines should give frames of one size.
    """
    columns = ["recording", "frames in both", "contact in both", "in the first only", "in the second only"]
    columns += ["outlines, mean IoU"]
    columns += [f"{name}: {which}" for name in QUANTITIES for which in ("median", "largest")]
    return Table(columns, [[name, *_row(read(first), read(second))] for name, first, second in results])


def read(result: Path) -> Frames:
    """The frames of a result, a `.jsonl` file or a folder of Parquet tables."""
    if result.is_dir():
        import pyarrow.parquet as pq  # type: ignore[import-untyped]

        names = ["seq", "contact_hull", *(name for names in QUANTITIES.values() for name in names)]
        return {row["seq"]: row for row in pq.read_table(result / "frames", columns=names).to_pylist()}
    messages = map(orjson.loads, result.read_bytes().splitlines())
    columns = frame_columns()
    return {message["seq"]: {c.name: c.value(message) for c in columns} for message in messages}


def _row(first: Frames, second: Frames) -> list[Any]:
    pairs = [(first[seq], second[seq]) for seq in sorted(first.keys() & second.keys())]
    hulls = [(one["contact_hull"], other["contact_hull"]) for one, other in pairs]
    both = [(one, other) for one, other in hulls if one and other]
    row: list[Any] = [len(pairs), len(both)]
    row += [sum(bool(one and not other) for one, other in hulls)]
    row += [sum(bool(other and not one) for one, other in hulls)]
    row.append(float(np.mean([_overlap(one, other) for one, other in both])) if both else None)
    for names in QUANTITIES.values():
        values = [[[frame[name] for name in names] for frame in pair] for pair in pairs]
        known = np.array([v for v in values if None not in v[0] + v[1]], float).reshape(-1, 2, len(names))
        difference = known[:, 1] - known[:, 0]
        if names[0].endswith("angle"):
            difference = (difference + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2
        lengths = np.linalg.norm(difference, axis=1)
        row += [float(np.median(lengths)), float(lengths.max())] if len(lengths) else [None, None]
    return row


def _overlap(first: list[list[float]], second: list[list[float]]) -> float:
    """Intersection over union of two convex outlines."""
    one, other = (np.array(hull, np.float32) for hull in (first, second))
    shared = float(cv2.intersectConvexConvex(one, other)[0])
    union = _area(one) + _area(other) - shared
    return shared / union if union > 0 else 0.0


def _area(hull: NDArray[np.float32]) -> float:
    return float(cv2.contourArea(hull))
