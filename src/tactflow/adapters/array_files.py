"""`tactflow export hdf5` and `tactflow export zarr`: a file of plain arrays for each recording, time first.

`frames` are the raw frames and `t` their times, which `ArrayDataset` plays again. The numbers of the result
message have the names, and the descriptions, of the columns of Parquet tables.
"""

from __future__ import annotations

import io
import logging
import math
import re
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactflow.engine.errors import StageError
from tactflow.message.columns import frame_columns
from tactflow.message.encoding import SCHEMA, STATUS_NAMES
from tactflow.message.episodes import at_rate
from tactflow.recording.provenance import facts
from tactflow.system.extras import missing
from tactflow.vision.types import Markers

if TYPE_CHECKING:
    from tactflow.message.result import Result
    from tactflow.vision.geometry import PixelMapping

log = logging.getLogger("tactflow")

CHUNK_BYTES: Final = 1 << 20
"""Values of an array are kept until they have so many bytes, and then written as one chunk: as much as HDF5
caches of a file."""
CHUNK_ROWS: Final = 4096
"""Most frames of a chunk, for arrays with one number per frame. Chosen by hand."""
FILL: Final[Mapping[str, tuple[str, float]]] = {
    "number": ("<f8", math.nan),
    "numbers": ("<f8", math.nan),
    "points": ("<f8", math.nan),
    "integer": ("<i8", -1),
    "boolean": ("i1", -1),
    "byte": ("u1", 255),
}
"""Kind of a column -> data type, and the value that stands for a missing one."""
UNIT: Final = re.compile(r"(?:^|, | and )(mm per px|mm\^[23]|px\^2|mm|px|degrees|N|s)(?=[ ;:,]|$)")
"""A unit in the description of a column."""
MARKERS: Final = {
    "markers_origin": ("points", "(N, M, 2): (x, y) of each marker in the reference frame, px"),
    "markers_position": ("points", "(N, M, 2): (x, y) of each marker now, px"),
    "markers_stderr": ("numbers", "(N, M): standard error of each coordinate of a position, px"),
    "markers_status": (
        "byte",
        f"(N, M): {', '.join(f'{value} {name}' for value, name in enumerate(STATUS_NAMES))}",
    ),
}
"""Name of an array -> kind and description. M grows when a new reference has more markers."""
NO_MARKERS: Final = Markers(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.uint8), np.empty(0))
"""Those of a frame that has none."""


def export_hdf5(
    folder: Path, episodes: Iterable[tuple[str, Iterable[Result]]], *, fps: int | None = None, **_: object
) -> None:
    """Write `episode_000.h5`, ... into a folder; an exporter of `tactflow export`.

    Parameters
    ----------
    folder : not there yet.
    episodes : the name of each recording, and its results with pictures.
    fps : frames per second, the nearest in time of each; None keeps every frame.

    Raises
    ------
    StageError : h5py is missing, or a recording has no frames. OSError : a file cannot be written.
    """
    _require("HDF5", "hdf5", "h5py")
    _export(folder, episodes, fps, Hdf5, ".h5")


def export_zarr(
    folder: Path, episodes: Iterable[tuple[str, Iterable[Result]]], *, fps: int | None = None, **_: object
) -> None:
    """Write `episode_000.zarr`, ... into a folder; otherwise as `export_hdf5`."""
    _require("Zarr", "zarr", "zarr")
    _export(folder, episodes, fps, Zarr, ".zarr")


def _require(what: str, extra: str, module: str) -> None:
    problem = missing(f"{what} files", extra, [module])
    if problem is not None:
        raise StageError(problem)


def _export(
    folder: Path,
    episodes: Iterable[tuple[str, Iterable[Result]]],
    fps: int | None,
    kind: type[Hdf5] | type[Zarr],
    suffix: str,
) -> None:
    folder.mkdir()
    for index, (name, results) in enumerate(episodes):
        path = folder / f"episode_{index:03d}{suffix}"
        with closing(kind(path)) as file:
            frames = write(file, name, results if fps is None else at_rate(results, fps))
        log.info("%s: %d frames from %s", path.name, frames, name)


def write(file: Hdf5 | Zarr, name: str, results: Iterable[Result]) -> int:
    """Write the results of a recording; returns their number.

    name : of the recording. results : with pictures.

    Raises
    ------
    StageError : there are none. OSError : they cannot be written.
    """
    arrays = _make_arrays(file)
    frames = 0
    for result in results:
        if not frames:
            file.group.attrs.update(_about(name, result))
        for array, value in _row(result).items():
            arrays[array].add(value)
        file.check()
        frames += 1
    if not frames:
        raise StageError("there is no frame in it")
    for unfinished in arrays.values():
        unfinished.flush()
    return frames


def _about(name: str, result: Result) -> dict[str, Any]:
    """The attributes of a file: where it comes from, and how its pixels are made."""
    about = {"recording": name, "schema": SCHEMA, **facts(result.sensor, None)}
    mapping: PixelMapping | None = result.value("mapping")
    return about if mapping is None else about | {"raw_to_processed": mapping.matrix.tolist()}


class Array:
    """One array of a file: grows by a value per frame, and is written a chunk at a time.

    Values may differ in length; shorter ones are padded with the value for what is missing.

    kind : a key of `FILL`. description : an attribute of the array, as are its unit and, where it is not NaN,
    the value for what is missing.
    """

    def __init__(self, file: Hdf5 | Zarr, name: str, kind: str, description: str) -> None:
        self._file, self._name = file, name
        self._dtype, self._fill = FILL[kind]
        self._about: dict[str, Any] = {"description": description}
        # Where there are several, the description says which is whose.
        if len(units := set(UNIT.findall(description))) == 1:
            self._about["units"] = units.pop()
        if kind in ("integer", "boolean") or name == "markers_status":
            self._about["missing"] = int(self._fill)
        self._array: Any = None
        self._waiting: list[NDArray[Any]] = []
        self._bytes = 0

    def add(self, value: ArrayLike) -> None:
        """Append the value of one frame. Raises OSError if a chunk cannot be written."""
        row = np.array(value, self._dtype)
        self._waiting.append(row)
        self._bytes += row.nbytes
        rows = len(self._waiting)
        is_full = rows == CHUNK_ROWS or self._bytes >= CHUNK_BYTES
        if is_full if self._array is None else rows == self._array.chunks[0]:
            self.flush()

    def flush(self) -> None:
        """Write the values that wait. Raises OSError if they cannot be written."""
        rows, self._waiting, self._bytes = self._waiting, [], 0
        if not rows:
            return
        shape = tuple(map(max, zip(*(row.shape for row in rows), strict=True)))
        values = np.full((len(rows), *shape), self._fill, self._dtype)
        for index, row in enumerate(rows):
            values[(slice(index, index + 1), *_first(row.shape))] = row
        if self._array is None:
            self._array = self._file.create(self._name, values, self._fill)
            self._array.attrs.update(self._about)
        begin, *before = self._array.shape
        self._array.resize((begin + len(rows), *map(max, before, shape)))
        if values.size:
            self._array[(slice(begin, begin + len(rows)), *_first(shape))] = values


def _first(shape: tuple[int, ...]) -> list[slice]:
    """The first elements along each axis."""
    return [slice(length) for length in shape]


def _make_arrays(file: Hdf5 | Zarr) -> dict[str, Array]:
    """All arrays of a file; texts are left out."""
    columns = {
        "frames": ("byte", "(N, H, W, 3): raw frames, grey levels, BGR"),
        "reference": (
            "boolean",
            "(N,): 1 where a frame shows the untouched gel that later ones are compared with",
        ),
        **{column.name: (column.kind, column.description) for column in frame_columns()},
        **MARKERS,
    }
    return {
        name: Array(file, name, kind, description)
        for name, (kind, description) in columns.items()
        if kind in FILL
    }


def _row(result: Result) -> dict[str, ArrayLike]:
    """The values of one frame, by the names of the arrays."""
    message = result.to_dict(detail=True)
    row: dict[str, ArrayLike] = {"frames": result.frame.image, "reference": result.frame.reference}
    for column in frame_columns():
        if column.kind in FILL:
            value = column.value(message)
            row[column.name] = _empty(column.kind) if value is None else value
    return row | _marker_row(result.markers)


def _empty(kind: str) -> ArrayLike:
    """What stands for a missing value before it is padded."""
    return np.empty((0, 2)) if kind == "points" else () if kind == "numbers" else FILL[kind][1]


def _marker_row(markers: Markers | None) -> dict[str, ArrayLike]:
    found = NO_MARKERS if markers is None else markers
    return {name: getattr(found, name.removeprefix("markers_")) for name in MARKERS}


class Hdf5:
    """An HDF5 file to write. path : of the file. Raises OSError if it cannot be made."""

    def __init__(self, path: Path) -> None:
        import h5py  # type: ignore[import-untyped]

        self._disk = _Disk(path, "w+")
        self.group: Any = h5py.File(self._disk, "w")

    def create(self, name: str, first: NDArray[Any], fill: float) -> Any:
        """Make an empty array with chunks of the shape of its first values."""
        return self.group.create_dataset(
            name,
            (0, *first.shape[1:]),
            first.dtype,
            maxshape=(None,) * first.ndim,
            chunks=_chunk(first),
            fillvalue=fill,
            # Any program that knows HDF5 can unpack it.
            compression="gzip",
            compression_opts=1,
            shuffle=True,
        )

    def check(self) -> None:
        """Raise OSError if something could not be written."""
        if self._disk.error is not None:
            raise self._disk.error

    def close(self) -> None:
        """Complete the file. Raises as `check`."""
        self.group.close()
        self._disk.close()
        self.check()


class _Disk(io.FileIO):
    """A file that remembers why it could not be written, and takes what follows for written.

    HDF5 2.0 crashes at the end of the process if a file could not be completed.
    """

    error: OSError | None = None

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        while self.error is None and len(left):
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes


class Zarr:
    """A Zarr folder to write. path : of the folder. Raises OSError if it cannot be made."""

    def __init__(self, path: Path) -> None:
        import zarr

        # Version 2 of the package, too, reads this format.
        self.group: Any = zarr.open_group(path, mode="w", zarr_format=2)

    def create(self, name: str, first: NDArray[Any], fill: float) -> Any:
        """As `Hdf5.create`."""
        return self.group.create_array(
            name,
            shape=(0, *first.shape[1:]),
            dtype=first.dtype,
            chunks=_chunk(first),
            fill_value=fill,
            # A source must be able to tell black pictures from those that were never written.
            config={"write_empty_chunks": True},
        )

    def check(self) -> None:
        """Nothing to do: the package raises OSError at once."""

    def close(self) -> None:
        """Nothing to do: every chunk is a file."""


def _chunk(first: NDArray[Any]) -> tuple[int, ...]:
    return tuple(max(length, 1) for length in first.shape)
