"""Frames in a column of pictures of a Parquet file, as Hugging Face's datasets have it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources.base import DEFAULT_FPS, FrameReader, damaged, require
from tactflow.sources.files import decode_image, natural_key
from tactflow.sources.paths import find_path, listed, split_query

SETTINGS = {"column": "name of a column with pictures"}
BATCH_ROWS = 16
"""Number of pictures read at a time."""
BUFFER_BYTES = 1 << 20
"""Size of the pieces in which a column is read, bytes; by default, all row groups are kept in memory."""


class PictureColumn(FrameReader):
    """The pictures of one column, one row per frame; frame i is taken at i / fps.

    A picture is the bytes of a JPEG, PNG or other image file, by themselves or in a struct with the field
    `bytes`.

    Parameters
    ----------
    spec : `file.parquet?column=image`, or a folder of that name with several files, which are read in
        natural order; a single column of pictures need not be named.
    directory, fps : as for `open_source`. Raises SourceError if there is no such file or column (it lists
        the valid ones), or a package is missing.
    """

    # Arrow raises all kinds of errors.
    parser_errors = (Exception,)

    def __init__(self, spec: str, directory: Path | None = None, fps: float | None = None) -> None:
        require(spec, "Parquet files", "parquet", "pyarrow")
        import pyarrow.parquet as pq  # type: ignore[import-untyped]

        name, settings = split_query(spec, directory, SETTINGS)
        path = find_path(name, directory)
        super().__init__(str(path))
        self.fps = fps or DEFAULT_FPS
        try:
            files = path.glob("*.parquet") if path.is_dir() else [path]
            self._files = sorted(files, key=lambda file: natural_key(file.name))
            if not self._files:
                raise SourceError(f"{path}: there is no .parquet file in this folder")
            self._column = _choose(spec, settings.get("column"), pq.read_schema(self._files[0]))
            self.name = f"{path}, {self._column}"
            self.total = sum(pq.read_metadata(file).num_rows for file in self._files)
        except SourceError:
            raise
        except Exception as error:
            raise damaged(self.name, error) from error
        self._read_first()
        self.description = f"{spec}, {self.total} frames"

    def _frames(self) -> Iterator[tuple[NDArray[Any], float]]:
        for index, value in enumerate(self._values()):
            place = f"{self.name}, row {index}"
            data = value.get("bytes") if isinstance(value, dict) else value
            if data is None:
                # It may be any file of this machine.
                path = value.get("path") if isinstance(value, dict) else None
                where = f"; it is in another file, {path}, which is not read" if path else ""
                raise SourceError(f"{place}: there is no picture in this row{where}")
            yield decode_image(data, place), index / (self.fps or DEFAULT_FPS)

    def _values(self) -> Iterator[Any]:
        import pyarrow.parquet as pq

        for path in self._files:
            with pq.ParquetFile(path, buffer_size=BUFFER_BYTES, pre_buffer=False) as file:
                for batch in file.iter_batches(BATCH_ROWS, columns=[self._column], use_threads=False):
                    yield from batch.column(0).to_pylist()


def _choose(spec: str, name: str | None, schema: Any) -> str:
    """The requested column, if it has pictures; without a request, the only column with pictures."""
    pictures = [str(field.name) for field in schema if _holds_files(field.type)]
    if name is not None and name in pictures:
        return name
    if name is None and len(pictures) == 1:
        return pictures[0]
    columns = listed([f"{field.name} ({_brief(field.type)})" for field in schema])
    if not pictures:
        raise SourceError(f"{spec}: no column holds pictures (bytes, or bytes and path); there are {columns}")
    problem = "add ?column=" if name is None else f"{name} is no column with pictures; required"
    raise SourceError(f"{spec}: {problem} one of: {listed(pictures)}; the columns are {columns}")


def _holds_files(kind: Any) -> bool:
    """Whether a type of Arrow is bytes, or a struct with bytes."""
    import pyarrow.types as types  # type: ignore[import-untyped]

    if types.is_struct(kind):
        return any(field.name == "bytes" and _holds_files(field.type) for field in kind.fields)
    return bool(types.is_binary(kind) or types.is_large_binary(kind) or types.is_fixed_size_binary(kind))


def _brief(kind: Any) -> str:
    text = str(kind)
    return text if len(text) <= 40 else f"{text[:37]}..."
