"""Write a scene to files: its frames, and the truth.

Frames are rendered and written one at a time. Until a file is complete, its name begins with a dot.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from tactflow.sim.scenes import Scene
from tactflow.system.files import completed

TRUTH_SUFFIXES: Final = (".jsonl", ".csv")
Report = Callable[[int], None]
"""Called with the number of frames written so far."""


def write_frames(scene: Scene, path: Path, report: Report = lambda _done: None) -> None:
    """Write all frames of a scene to a `.npy` file (uint8 N x H x W x 3 BGR), which is overwritten.

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

    Raises OSError if the path is not writable.
    """
    with completed(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file) if path.suffix.lower() == ".csv" else None
        if table is not None:
            table.writerow(["t", "fx", "fy", "fz"])
        for index in range(len(scene)):
            if table is not None:
                table.writerow([index / scene.fps, *scene.truth(index).force])
            else:
                file.write(json.dumps(_line(scene, index), allow_nan=False, separators=(",", ":")) + "\n")
            report(index + 1)


def _line(scene: Scene, index: int) -> dict[str, object]:
    truth = scene.truth(index)
    names = ("touching", "center", "angle", "hull", "area", "depth", "origin", "position", "visible")
    values = {name: getattr(truth, name) for name in names}
    listed = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}
    return {"frame": index, "t": index / scene.fps, **listed, "mean_flow": truth.contact_flow}
