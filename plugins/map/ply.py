"""PLY files of points, binary, little endian."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from .surface import Points

FIELDS: Final = (
    *(("x", "<f4"), ("y", "<f4"), ("z", "<f4")),
    *(("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")),
    *(("red", "u1"), ("green", "u1"), ("blue", "u1")),
    *(("error", "<f4"), ("shift", "<f4")),
)
"""Properties of a point, and their types: places, normals that point out of the object, colours, and the
standard errors along the normal and along the surface; mm."""
RAMP: Final = ((0.13, 0.97, 0.70), (0.40, 0.97, 0.09), (0.67, 0.97, 0.17))
"""Red, green and blue of colours of errors: none, half of the largest, the largest."""
MAX_MEDIANS: Final = 3.0
"""Largest error that has a colour of its own, in medians of all errors."""
_PLY_TYPES: Final = {"<f4": "float", "u1": "uchar"}


def write_ply(path: Path, points: Points, colours: NDArray[np.uint8]) -> None:
    """Write points. colours : (N, 3), red, green, blue. Raises OSError where the path is not writable."""
    table = np.empty(len(points), list(FIELDS))
    parts: dict[tuple[str, ...], NDArray[Any]] = {
        ("x", "y", "z"): points.place,
        ("nx", "ny", "nz"): points.normal,
        ("red", "green", "blue"): colours,
        ("error", "shift"): np.column_stack([points.error, points.shift]),
    }
    for names, values in parts.items():
        for name, column in zip(names, values.T, strict=True):
            table[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment mm; error and shift: standard errors along the normal and along the surface",
        f"element vertex {len(table)}",
        *(f"property {_PLY_TYPES[kind]} {name}" for name, kind in FIELDS),
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode() + table.tobytes())


def read_ply(path: Path) -> NDArray[np.void]:
    """The points of a file of `write_ply`, a record each, with the names of `FIELDS`."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    return np.frombuffer(body, list(FIELDS), count)


def error_colours(points: Points) -> NDArray[np.uint8]:
    """(N, 3): colours by `error`, along `RAMP` up to `MAX_MEDIANS` medians."""
    share = np.clip(points.error / (MAX_MEDIANS * np.median(points.error)), 0, 1)
    return np.rint(255 * np.column_stack([np.interp(share, (0, 0.5, 1), part) for part in RAMP])).astype(
        np.uint8
    )
