"""Write a scene to files: its frames, and the truth.

Frames are rendered and written one at a time. Until a file is complete, its name begins with a dot.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tactflow.sim.scenes import Scene
from tactflow.sim.truth import Truth
from tactflow.system.files import completed

Report = Callable[[int], None]


def write_frames(scene: Scene, path: Path, report: Report = lambda _done: None) -> None:
    """Write all frames of a scene.

    path : a `.npy` file (uint8 N x H x W x 3 BGR); overwritten.
    report : called with the number of frames written so far.

    Raises OSError if the path is not writable.
    """
    # Not memory-mapped, so that a full disk raises OSError instead of SIGBUS.
    width, height = scene.size
    header = {"descr": "|u1", "fortran_order": False, "shape": (len(scene), height, width, 3)}
    with completed(path) as partial, partial.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for index in range(len(scene)):
            file.write(np.ascontiguousarray(scene.frame(index)).data)
            report(index + 1)


def write_truth(scene: Scene, path: Path, report: Report = lambda _done: None) -> None:
    """Write the truth about all frames, in raw pixel coordinates.

    path : `.jsonl` has a JSON object per frame: frame, t (s), touching, center, angle, hull, area, depth,
        origin, position, visible, mean_flow, null if missing. `.csv` is the log of a force gauge: t (s), fx,
        fy, fz (N). Masks are in `open_scene(name).truth(index)`.
    report : called with the number of frames written so far.

    Raises KeyError for another suffix and OSError if the path is not writable.
    """
    write = TRUTH_WRITERS[path.suffix.lower()]
    with completed(path) as partial:
        write(scene, partial, report)


def _truths(scene: Scene, report: Report) -> Iterator[tuple[int, Truth]]:
    for index in range(len(scene)):
        yield index, scene.truth(index)
        report(index + 1)


def _write_jsonl(scene: Scene, path: Path, report: Report) -> None:
    with path.open("w", encoding="utf-8") as file:
        for index, truth in _truths(scene, report):
            line = {
                "frame": index,
                "t": index / scene.fps,
                "touching": truth.touching,
                "center": truth.center,
                "angle": truth.angle,
                "hull": truth.hull.tolist(),
                "area": truth.area,
                "depth": truth.depth,
                "origin": truth.origin.tolist(),
                "position": truth.position.tolist(),
                "visible": truth.visible.tolist(),
                "mean_flow": truth.mean_flow,
            }
            file.write(json.dumps(line, allow_nan=False, separators=(",", ":")) + "\n")


def _write_forces(scene: Scene, path: Path, report: Report) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t", "fx", "fy", "fz"])
        for index, truth in _truths(scene, report):
            table.writerow([index / scene.fps, *truth.force])


TRUTH_WRITERS = {".jsonl": _write_jsonl, ".csv": _write_forces}
"""Suffix of a file -> the function that writes the truth to it."""
