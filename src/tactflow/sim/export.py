"""Write a scene to disk: lossless frames, and the truth.

Frames are rendered and written one at a time. Until a file is complete, its name begins with a dot.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from tactflow.sim.scenes import Scene
from tactflow.sim.truth import Truth
from tactflow.system.files import completed

TRUTH_SUFFIXES = (".jsonl", ".csv")
Report = Callable[[int], None]


def write_frames(scene: Scene, path: Path, report: Report = lambda _done: None) -> None:
    """Write all frames of a scene.

    path : `.npy` (uint8 N x H x W x 3 BGR) or, without a suffix, a folder of numbered PNG files. Overwrites
        existing files.
    report : called with the number of frames written so far.

    Raises ValueError for an unsupported suffix and OSError if the path is not writable.
    """
    write = frames_writer(path)
    with completed(path) as partial:
        write(scene, partial, report)


def write_truth(scene: Scene, path: Path, report: Report = lambda _done: None) -> None:
    """Write the truth about all frames, in raw pixel coordinates.

    path : `.jsonl` has a JSON object per frame: frame, t (s), touching, center, angle, hull, area, depth,
        origin, position, visible, mean_flow, null if missing. `.csv` is the log of a force gauge: t (s), fx,
        fy, fz (N). Masks are in `open_scene(name).truth(index)`.
    report : called with the number of frames written so far.

    Raises ValueError for an unsupported suffix and OSError if the path is not writable.
    """
    suffix = path.suffix.lower()
    if suffix not in TRUTH_SUFFIXES:
        raise ValueError(f"required the truth as {' or '.join(TRUTH_SUFFIXES)}, got {path.name!r}")
    with completed(path) as partial:
        {".jsonl": _write_jsonl, ".csv": _write_forces}[suffix](scene, partial, report)


def frames_writer(path: Path) -> Callable[[Scene, Path, Report], None]:
    """The function that writes frames to such a path; raises ValueError for an unsupported suffix."""
    if path.is_dir() or not path.suffix:
        return _write_folder
    if path.suffix.lower() != ".npy":
        raise ValueError(f"required frames as .npy or a folder, got {path.name!r}")
    return _write_npy


def _write_npy(scene: Scene, path: Path, report: Report) -> None:
    # Not memory-mapped, so that a full disk raises OSError instead of SIGBUS.
    width, height = scene.size
    header = {"descr": "|u1", "fortran_order": False, "shape": (len(scene), height, width, 3)}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for index in range(len(scene)):
            file.write(np.ascontiguousarray(scene.frame(index)).data)
            report(index + 1)


def _write_folder(scene: Scene, path: Path, report: Report) -> None:
    path.mkdir()
    digits = max(6, len(str(len(scene) - 1)))
    for index in range(len(scene)):
        encoded = cv2.imencode(".png", scene.frame(index))[1]
        (path / f"{index:0{digits}d}.png").write_bytes(encoded.tobytes())
        report(index + 1)


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
