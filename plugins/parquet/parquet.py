"""Parquet: results as tables for pandas, Polars, DuckDB and everything else that reads Parquet."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
from pydantic import Field

from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.message.columns import Column, contact_columns, frame_columns, marker_columns, marker_rows
from tactflow.message.fields import SCHEMA
from tactflow.message.result import Result, encode_message
from tactflow.outputs import AppendParams, OutputSink, cannot_write, locked_folder
from tactflow.recording.provenance import facts, kept_files
from tactflow.system.extras import missing
from tactflow.system.files import completed, expanded, make_folder

if TYPE_CHECKING:
    import pyarrow as pa  # type: ignore[import-untyped]

SEQ = Column("seq", ("seq",), "integer", "the frame's seq in the table frames")
CONTACT = Column("contact", (), "integer", "0 is the contact with the most pixels")
TABLES = {
    "markers": (SEQ, *marker_columns()),
    "contacts": (SEQ, CONTACT, *contact_columns()),
    "frames": tuple(frame_columns()),
}
"""Tables in the order of writing: the rows that belong to a row of `frames` exist before it."""
PART_ROWS = 200_000
"""Number of rows of a table at which a part is written early: with some 20 numbers each, they take 100 MB."""
BATCH_ROWS = 1000
"""Number of rows converted to Arrow at a time: converting a whole part would block the other threads."""

Rows = dict[str, list[tuple[Any, ...]]]
"""Name of a table -> its rows."""


class Parquet(OutputSink):
    """Writes result messages to `path/frames/`, `path/contacts/` and `path/markers/`.

    `frames` has a row per frame, `contacts` one per separate contact, `markers` one per dot and frame. Each
    table is a folder of parts, `part-00000.parquet`, which pandas, pyarrow, Polars and DuckDB read as one. A
    part is written every `flush` seconds and at the end, and gets its name when it is complete: if the
    process ends abruptly, at most the rows since the last part are lost.
    """

    queue_capacity = 16

    class Params(AppendParams):
        """Destination."""

        path: str = Field(
            "results", min_length=1, description="folder, relative to the current directory; created"
        )
        flush: float = Field(10.0, gt=0, description="longest time that rows are buffered, s")

    def __init__(self, params: Params, sensor: str = "main", control: Control | None = None) -> None:
        """Prepare; nothing is opened yet.

        sensor, control : name of the sensor and the run, for the metadata.
        """
        super().__init__(params)
        self._folder = expanded(params.path)
        self._lock = ExitStack()
        self._sensor = sensor
        self._control = control
        self._schemas: dict[str, pa.Schema] = {}
        self._rows: Rows = {name: [] for name in TABLES}
        self._flushed = 0.0
        self._next: int | None = None
        self._counts = {"frames": 0, "parts": 0}

    def open(self) -> None:
        """Create the folders.

        Raises StageError if there are tables and neither `overwrite` nor `append` is set, another run is
        writing to the folder, it cannot be written, or a package is missing.
        """
        problem = missing("Parquet tables", "parquet", ["pyarrow"])
        if problem is not None:
            raise StageError(problem)
        # Now rather than in the middle of the run; the first array imports pandas if it is installed.
        import pyarrow.parquet  # type: ignore[import-untyped]

        pyarrow.array([0])
        self._lock.enter_context(locked_folder(self._folder))
        try:
            for name in TABLES:
                make_folder(self._folder / name)
            if self.params.refuses_existing and self._parts():
                raise StageError(
                    f"{self._folder}: already holds tables; set overwrite: true to replace them, append: "
                    "true to extend them, or choose another folder"
                )
        except OSError as error:
            raise cannot_write(self._folder, error) from error
        files = kept_files(self._control).items()
        texts = {name: data.decode() for name, data in files if name.endswith(".yaml")}
        about = {"schema": SCHEMA, **facts(self._sensor, self._control), **texts}
        self._schemas = _make_schemas(about)
        self._flushed = time.monotonic()

    def begin(self) -> None:
        """Remove tables that are replaced. Called once, or by the first `write`."""
        if self._next is not None:
            return
        present = self._parts()
        if self.params.overwrite:
            try:
                # Frames first, so that none remains without its rows in the other tables.
                for part in reversed(present):
                    part.unlink()
            except OSError as error:
                raise cannot_write(self._folder, error) from error
            present = []
        numbers = (part.stem.removeprefix("part-") for part in present)
        self._next = max((int(number) + 1 for number in numbers if number.isdecimal()), default=0)

    def counters(self) -> Mapping[str, int]:
        """frames : in complete parts. parts : per table."""
        return self._counts

    def write(self, result: Result) -> None:
        """Buffer one frame, and write a part when it is due.

        Raises StageError if the part cannot be written, as on a full disk. Earlier parts stay.
        """
        self.begin()
        message = orjson.loads(encode_message(result, detail=True))
        for name, rows in _rows(message).items():
            self._rows[name].extend(rows)
        is_due = time.monotonic() - self._flushed >= self.params.flush
        if is_due or max(map(len, self._rows.values())) >= PART_ROWS:
            self._flush()

    def close(self) -> None:
        """Write the last part. Raises as `write`."""
        with self._lock:
            self._flush()

    def _parts(self) -> list[Path]:
        """The parts of all tables, those of `frames` last."""
        return [part for name in TABLES for part in (self._folder / name).glob("part-*.parquet")]

    def _flush(self) -> None:
        import pyarrow.parquet as pq

        rows, self._rows = self._rows, {name: [] for name in TABLES}
        self._flushed = time.monotonic()
        count = len(rows["frames"])
        if not count or self._next is None:
            return
        try:
            for name, schema in self._schemas.items():
                # Until it is complete, its name begins with a dot, so that readers of the folder ignore it.
                part = self._folder / name / f"part-{self._next:05d}.parquet"
                # A folder that was removed meanwhile is an error.
                with completed(part, make_parent=False) as unfinished, unfinished.open("wb") as file:
                    pq.write_table(_table(rows[name], schema), file, compression="zstd")
                    file.flush()
                    # Sync before renaming, so that a power cut leaves no empty part.
                    os.fsync(file.fileno())
        except OSError as error:
            kept = f"the {self._counts['frames']} frames written before are complete; not written: {count}"
            raise cannot_write(self._folder, error, kept) from error
        self._next += 1
        self._counts = {"frames": self._counts["frames"] + count, "parts": self._counts["parts"] + 1}


def _table(rows: Sequence[tuple[Any, ...]], schema: pa.Schema) -> pa.Table:
    import pyarrow as pa

    batches = []
    for begin in range(0, len(rows), BATCH_ROWS):
        columns = zip(zip(*rows[begin : begin + BATCH_ROWS], strict=True), schema, strict=True)
        arrays = [pa.array(column, field.type) for column, field in columns]
        batches.append(pa.record_batch(arrays, schema=schema))
    return pa.Table.from_batches(batches, schema)


def _make_schemas(metadata: Mapping[str, str]) -> dict[str, pa.Schema]:
    """The Arrow schema of each table. metadata : of every table."""
    import pyarrow as pa

    types = {
        "number": pa.float64(),
        "integer": pa.int64(),
        "boolean": pa.bool_(),
        "string": pa.string(),
        "numbers": pa.list_(pa.float64()),
        "points": pa.list_(pa.list_(pa.float64())),
        "words": pa.map_(pa.string(), pa.string()),
    }
    return {
        name: pa.schema(
            [pa.field(c.name, types[c.kind], metadata={"description": c.description}) for c in columns],
            metadata=dict(metadata),
        )
        for name, columns in TABLES.items()
    }


def _rows(message: Mapping[str, Any]) -> Rows:
    """The rows of each table for one parsed result message."""
    seq = message["seq"]
    contacts = [
        (seq, index, *(column.value(contact) for column in contact_columns()))
        for index, contact in enumerate(message["contacts"])
    ]
    markers = [(seq, *row) for row in marker_rows(message["markers"])]
    frame = tuple(column.value(message) for column in frame_columns())
    return {"markers": markers, "contacts": contacts, "frames": [frame]}
