"""`tactflow export hdf5`: a file of plain arrays for each recording, time first.

`frames` are the raw frames and `t` their times, which `ArrayDataset` plays again. The numbers of the result
message have the names, and the descriptions, of the columns of Parquet tables.
"""

from __future__ import annotations

import io
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from tactflow.engine.errors import StageError
from tactflow.message.columns import frame_columns
from tactflow.message.episodes import at_rate
from tactflow.message.fields import SCHEMA, STATUS_NAMES
from tactflow.recording.provenance import facts
from tactflow.system.extras import missing
from tactflow.vision.types import Markers

if TYPE_CHECKING:
    from tactflow.message.result import Result
    from tactflow.vision.geometry import PixelMapping

log = logging.getLogger("tactflow")

CHUNK_FRAMES: Final = 1024
"""Number of frames per chunk of the arrays of numbers. Chosen by hand."""
DTYPES_AND_FILLS: Final[Mapping[str, tuple[str, float]]] = {
    "number": ("<f8", math.nan),
    "numbers": ("<f8", math.nan),
    "points": ("<f8", math.nan),
    "integer": ("<i8", -1),
    "boolean": ("i1", -1),
    "byte": ("u1", 255),
}
"""Kind of a column -> data type, and the placeholder for a missing value, which is the array's fill value."""
STATUS: Final = ", ".join(f"{value} {name}" for value, name in enumerate(STATUS_NAMES))
ARRAYS: Final[Mapping[str, tuple[str, str]]] = {
    "frames": ("byte", "(N, H, W, 3): raw frames, grey levels, BGR"),
    "reference": (
        "boolean",
        "(N,): 1 where a frame shows the untouched gel that later ones are compared with",
    ),
    **{
        column.name: (column.kind, column.description)
        for column in frame_columns()
        if column.kind in DTYPES_AND_FILLS
    },
    "markers_origin": ("points", "(N, M, 2): (x, y) of each marker in the reference frame, px"),
    "markers_position": ("points", "(N, M, 2): (x, y) of each marker now, px"),
    "markers_stderr": ("numbers", "(N, M): standard error of each coordinate of a position, px"),
    "markers_status": ("byte", f"(N, M): {STATUS}"),
}
"""Name of each array -> kind and description; texts are left out. M grows when a new reference has more
markers."""
NO_MARKERS: Final = Markers(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.uint8), np.empty(0))
"""The markers of a frame without any."""


def export(
    folder: Path, episodes: Iterable[tuple[str, Iterable[Result]]], *, fps: int | None = None, **_: object
) -> None:
    """Write `episode_000.h5`, ... into a folder, for `tactflow export`.

    Parameters
    ----------
    folder : must not exist.
    episodes : the name of each recording, and its results with pictures.
    fps : frames per second, the nearest in time of each; None keeps every frame.

    Raises
    ------
    StageError : h5py is missing, or a recording has no frames. OSError : a file cannot be written.
    """
    problem = missing("HDF5 files", "hdf5", ["h5py"])
    if problem is not None:
        raise StageError(problem)
    folder.mkdir()
    for index, (name, results) in enumerate(episodes):
        path = folder / f"episode_{index:03d}.h5"
        with closing(ArrayFile(path)) as file:
            frames = file.write(name, results if fps is None else at_rate(results, fps))
        log.info("%s: %d frames from %s", path.name, frames, name)


class ArrayFile:
    """Writes an HDF5 file with one array per quantity, all of which grow along their first axis.

    Parameters
    ----------
    path : of the file. Raises OSError if it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        import h5py  # type: ignore[import-untyped]

        self._disk = _Disk(path, "w+")
        self._file = h5py.File(self._disk, "w")
        self._rows: list[dict[str, ArrayLike]] = []

    def write(self, name: str, results: Iterable[Result]) -> int:
        """Write the results of a recording; returns their number.

        name : of the recording. results : with pictures.

        Raises
        ------
        StageError : there are none. OSError : they cannot be written.
        """
        frames = 0
        for result in results:
            if not frames:
                self._file.attrs.update(_file_attributes(name, result))
            self._append("frames", [result.frame.image])
            self._rows.append(_row(result))
            if len(self._rows) == CHUNK_FRAMES:
                self._flush()
            frames += 1
        if not frames:
            raise StageError("there is no frame in it")
        self._flush()
        return frames

    def close(self) -> None:
        """Complete the file. Raises OSError if it could not be written."""
        self._file.close()
        self._disk.close()
        self._disk.check()

    def _flush(self) -> None:
        """Write the buffered numbers."""
        rows, self._rows = self._rows, []
        for name in rows[0] if rows else ():
            self._append(name, [row[name] for row in rows])

    def _append(self, name: str, values: Sequence[ArrayLike]) -> None:
        """Append values; shorter ones are padded."""
        dtype, fill = DTYPES_AND_FILLS[ARRAYS[name][0]]
        rows = [np.asarray(value, dtype) for value in values]
        shape = tuple(map(max, zip(*(row.shape for row in rows), strict=True)))
        block = np.full((len(rows), *shape), fill, dtype)
        for index, row in enumerate(rows):
            block[(slice(index, index + 1), *map(slice, row.shape))] = row
        array = self._file.get(name)
        if array is None:
            array = self._create(name, block)
        begin, *before = array.shape
        array.resize((begin + len(rows), *map(max, before, shape)))
        if block.size:
            array[(slice(begin, begin + len(rows)), *map(slice, shape))] = block
        self._disk.check()

    def _create(self, name: str, block: np.ndarray[Any, Any]) -> Any:
        """Create an empty array for blocks like this one."""
        kind, description = ARRAYS[name]
        array = self._file.create_dataset(
            name,
            (0, *block.shape[1:]),
            block.dtype,
            chunks=tuple(max(length, 1) for length in block.shape),
            maxshape=(None,) * block.ndim,
            fillvalue=DTYPES_AND_FILLS[kind][1],
            # Every HDF5 library can unpack gzip.
            compression="gzip",
            compression_opts=1,
            shuffle=True,
        )
        array.attrs["description"] = description
        return array


class _Disk(io.FileIO):
    """A file that remembers a write error, and pretends that later writes succeed.

    HDF5 2.0 crashes at the end of the process if a file could not be completed.
    """

    _error: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        while self._error is None and len(left):
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self._error = error
        return memoryview(data).nbytes

    def check(self) -> None:
        """Raise the error of a failed write."""
        if self._error is not None:
            raise self._error


def _file_attributes(name: str, result: Result) -> dict[str, Any]:
    """Provenance of a recording, and the transform from its pixels to those of the processed frame."""
    attributes = {"recording": name, "schema": SCHEMA, **facts(result.sensor, None)}
    mapping: PixelMapping | None = result.value("mapping")
    return attributes if mapping is None else attributes | {"raw_to_processed": mapping.matrix.tolist()}


def _row(result: Result) -> dict[str, ArrayLike]:
    """The values of one frame, by the names of the arrays, without the picture."""
    message = result.to_dict(detail=True)
    row: dict[str, ArrayLike] = {"reference": result.frame.reference}
    for column in frame_columns():
        if column.kind in DTYPES_AND_FILLS:
            value = column.value(message)
            row[column.name] = _missing(column.kind) if value is None else value
    markers = NO_MARKERS if result.markers is None else result.markers
    for part in ("origin", "position", "stderr", "status"):
        row[f"markers_{part}"] = getattr(markers, part)
    return row


def _missing(kind: str) -> ArrayLike:
    """The placeholder for a missing value, before padding."""
    return np.empty((0, 2)) if kind == "points" else () if kind == "numbers" else DTYPES_AND_FILLS[kind][1]
