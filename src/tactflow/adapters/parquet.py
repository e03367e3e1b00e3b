"""Parquet: results as tables for pandas, Polars, DuckDB and everything else that reads Parquet."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Sink, StageParams
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.message.columns import MARKER_COLUMNS, Column, contact_columns, frame_columns
from tactflow.message.encoding import SCHEMA
from tactflow.message.result import Result, encode_message
from tactflow.recording.provenance import facts, kept_files
from tactflow.system.extras import missing
from tactflow.system.files import expanded, make_folder
from tactflow.system.outputs import cannot_write

if TYPE_CHECKING:
    import pyarrow as pa  # type: ignore[import-untyped]

SEQ = Column("seq", ("seq",), "integer", "the frame's seq in the table frames")
CONTACT = Column("contact", (), "integer", "0 is the contact with the most pixels")
TABLES = ("markers", "contacts", "frames")
"""In the order in which they are written: what belongs to a frame of `frames` is there before it."""
UNFINISHED = ".unfinished"
"""Prefix of a part that is being written: readers of folders leave out names that begin with a dot."""
PART_BYTES = 64_000_000
"""A part is written early when its messages take so much memory, bytes: some ten thousand frames."""


class Parquet(Sink):
    """Writes result messages to `path/frames/`, `path/contacts/` and `path/markers/`.

    `frames` has a row for each frame, `contacts` one for each separate contact, `markers` one for each dot of
    each frame. Each table is a folder of parts, `part-00000.parquet`, as pandas, pyarrow, Polars and DuckDB
    read it. A part is written every `flush` seconds and at the end, and gets its name when it is complete:
    if the process ends abruptly, at most the rows since the last part are lost.
    """

    threaded = True
    queue_capacity = 16

    class Params(StageParams):
        """Where to write, and what to do with existing tables."""

        path: str = Field(
            "results", min_length=1, description="folder, relative to the current directory; created"
        )
        overwrite: bool = Field(False, description="remove existing tables")
        append: bool = Field(False, description="add parts to existing tables")
        flush: float = Field(
            10.0, gt=0, description="longest time that rows wait before they are written as a part, s"
        )

        @model_validator(mode="after")
        def _exclusive(self) -> Parquet.Params:
            if self.overwrite and self.append:
                raise ValueError("overwrite and append exclude each other")
            return self

    def __init__(self, params: Params, sensor: str = "main", control: Control | None = None) -> None:
        """Prepare; nothing is opened yet.

        sensor, control : whose results they are, and the run, for the metadata.
        """
        super().__init__(params)
        self._folder = expanded(params.path)
        self.description = params.path
        self._sensor = sensor
        self._control = control
        self._schemas: dict[str, pa.Schema] = {}
        self._pending: list[bytes] = []
        self._flushed = 0.0
        self._next = 0
        self._counts = {"frames": 0, "parts": 0}

    @classmethod
    def outputs(cls, params: Parquet.Params) -> Sequence[Output]:
        """The folder."""
        keeps = not (params.overwrite or params.append)
        return (Output(expanded(params.path), "folder", "path", refuses_existing=keeps),)

    @classmethod
    def on_restart(cls, params: Parquet.Params) -> Parquet.Params:
        """It appends to its tables."""
        return params.changed(overwrite=False, append=True)

    def open(self) -> None:
        """Create the folders.

        Raises
        ------
        StageError
            If there are tables and neither `overwrite` nor `append` is set, the folder cannot be written, or
            a package is missing.
        """
        problem = missing("Parquet tables", "parquet", ["pyarrow"])
        if problem is not None:
            raise StageError(problem)
        # Now, and not in the middle of the run, when the first part is written.
        import pyarrow.parquet  # type: ignore[import-untyped]  # noqa: F401

        try:
            for name in TABLES:
                make_folder(self._folder / name)
            self._check_existing()
        except OSError as error:
            raise cannot_write(self._folder, error) from error
        files = kept_files(self._control).items()
        texts = {name: data.decode() for name, data in files if name.endswith(".yaml")}
        about = {"schema": SCHEMA, **facts(self._sensor, self._control), **texts}
        self._schemas = make_schemas(about)
        self._flushed = time.monotonic()

    def counters(self) -> Mapping[str, int]:
        """frames : in complete parts. parts : of each table."""
        return self._counts

    def write(self, result: Result) -> None:
        """Keep one frame, and write a part when it is time.

        Raises
        ------
        StageError
            If the part cannot be written, for instance because the disk is full. The parts before stay.
        """
        self._pending.append(encode_message(result, detail=True))
        due = time.monotonic() - self._flushed >= self.params.flush
        if due or len(self._pending) * len(self._pending[-1]) >= PART_BYTES:
            self._flush()

    def close(self) -> None:
        """Write the last part. Raises as `write`."""
        try:
            self._flush()
        finally:
            self._schemas = {}

    def _check_existing(self) -> None:
        """Refuse existing tables, remove them, or continue behind them."""
        present = [part for name in TABLES for part in (self._folder / name).glob("part-*.parquet")]
        if present and not (self.params.overwrite or self.params.append):
            raise StageError(
                f"{self._folder}: holds tables already; set overwrite: true to replace them, append: true to "
                "add to them, or give another folder"
            )
        if self.params.overwrite:
            # Frames first, so that none is left without its rows of the other tables.
            for part in reversed(present):
                part.unlink()
            present = []
        numbers = (part.stem.removeprefix("part-") for part in present)
        self._next = max((int(number) + 1 for number in numbers if number.isdecimal()), default=0)

    def _flush(self) -> None:
        import pyarrow.parquet as pq

        messages, self._pending = self._pending, []
        self._flushed = time.monotonic()
        if not messages or not self._schemas:
            return
        tables = make_tables([orjson.loads(message) for message in messages], self._schemas)
        unfinished = self._folder / UNFINISHED
        try:
            for name in TABLES:
                part = self._folder / name / f"part-{self._next:05d}.parquet"
                unfinished = part.with_name(f"{UNFINISHED}-{part.name}")
                with unfinished.open("wb") as file:
                    pq.write_table(tables[name], file, compression="zstd")
                    file.flush()
                    # On the disk before it gets its name, so that a power cut leaves no empty part.
                    os.fsync(file.fileno())
                unfinished.replace(part)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink()
            hint = "; free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
            kept = (
                f"the {self._counts['frames']} frames written before are complete; "
                f"not written: {len(messages)}{hint}"
            )
            raise cannot_write(self._folder, error, kept) from error
        self._next += 1
        self._counts = {"frames": self._counts["frames"] + len(messages), "parts": self._counts["parts"] + 1}


def make_schemas(metadata: Mapping[str, str]) -> dict[str, pa.Schema]:
    """The Arrow schema of each table. metadata : of every table.

    >>> make_schemas({})["markers"].names[:4]
    ['seq', 'marker', 'x', 'y']
    """
    import pyarrow as pa

    types = {
        "number": pa.float64(),
        "integer": pa.int64(),
        "boolean": pa.bool_(),
        "string": pa.string(),
        "points": pa.list_(pa.list_(pa.float64())),
        "words": pa.map_(pa.string(), pa.string()),
    }
    columns = {
        "frames": frame_columns(),
        "contacts": (SEQ, CONTACT, *contact_columns()),
        "markers": (SEQ, *MARKER_COLUMNS),
    }
    return {
        name: pa.schema(
            [pa.field(c.name, types[c.kind], metadata={"description": c.description}) for c in table],
            metadata=dict(metadata),
        )
        for name, table in columns.items()
    }


def make_tables(
    messages: Sequence[Mapping[str, Any]], schemas: Mapping[str, pa.Schema]
) -> dict[str, pa.Table]:
    """The tables `frames`, `contacts` and `markers` of parsed result messages."""
    import pyarrow as pa

    frames = [{column.name: column.value(message) for column in frame_columns()} for message in messages]
    contacts = [
        {"seq": message["seq"], "contact": index}
        | {column.name: column.value(contact) for column in contact_columns()}
        for message in messages
        for index, contact in enumerate(message["contacts"])
    ]
    # By columns, as there are thousands of rows a second.
    seen = [(m["seq"], m["markers"]) for m in messages if m["markers"] and m["markers"]["position"]]
    counts = [len(markers["position"]) for _, markers in seen]
    position, origin = (
        np.concatenate([np.empty((0, 2)), *(np.array(markers[key]) for _, markers in seen)])
        for key in ("position", "origin")
    )
    errors = (m.get("stderr", [None] * count) for (_, m), count in zip(seen, counts, strict=True))
    columns = [
        np.repeat(np.array([seq for seq, _ in seen], np.int64), counts),
        list(chain.from_iterable(map(range, counts))),
        *position.T,
        *(position - origin).T,
        *origin.T,
        list(chain.from_iterable(markers["status"] for _, markers in seen)),
        list(chain.from_iterable(errors)),
    ]
    schema = schemas["markers"]
    arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
    return {
        "frames": pa.Table.from_pylist(frames, schemas["frames"]),
        "contacts": pa.Table.from_pylist(contacts, schemas["contacts"]),
        "markers": pa.Table.from_arrays(arrays, schema=schema),
    }
