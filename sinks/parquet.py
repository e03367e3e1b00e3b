"""Parquet: results as tables for pandas, Polars, DuckDB and all else that reads Parquet."""

from __future__ import annotations

import errno
import logging
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import orjson
from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Sink, StageParams
from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.message.result import SCHEMA, Result, encode_message
from tactflow.system.extras import missing
from tactflow.system.files import claim_path, expanded, make_folder
from tactflow.system.provenance import facts, texts

if TYPE_CHECKING:
    import pyarrow as pa  # type: ignore[import-untyped]

    from tactflow.adapters.tables import Tables

log = logging.getLogger("tactflow")

TABLES = ("markers", "contacts", "frames")
"""In the order in which they are written: what belongs to a frame of `frames` is there before it."""
UNFINISHED = ".unfinished"
"""Beginning of the name of a part that is being written: what begins with a dot, readers of folders leave
out."""
PART_BYTES = 64_000_000
"""A part is written early when its messages take so much memory, bytes: some ten thousand frames."""


class Parquet(Sink):
    """Writes result messages to `path/frames/`, `path/contacts/` and `path/markers/`.

    `frames` has a row for each frame, `contacts` one for each separate contact, `markers` one for each dot of
    each frame. Each table is a folder of parts, `part-00000.parquet`, as pandas, pyarrow, Polars and DuckDB
    read it. A part is written every `flush` seconds and at the end, and gets its name when it is complete:
    what ends the process takes at most the rows since the last part.
    """

    threaded = True
    queue_capacity = 16

    class Params(StageParams):
        """Where to write, and what to do with tables that are there already."""

        path: str = Field(
            "results", min_length=1, description="folder, relative to the current directory; created"
        )
        overwrite: bool = Field(False, description="remove the tables that are there")
        append: bool = Field(False, description="add parts to the tables that are there")
        flush: float = Field(
            10.0, gt=0, description="longest time that rows wait before they are written as a part, s"
        )

        @model_validator(mode="after")
        def _one_of_both(self) -> Parquet.Params:
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
        self._claim: int | None = None
        self._tables: Tables | None = None
        self._pending: list[bytes] = []
        self._bytes = 0
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
        """It adds to its tables."""
        return params.changed(overwrite=False, append=True)

    def open(self) -> None:
        """Create the folders.

        Raises
        ------
        StageError
            If there are tables and neither `overwrite` nor `append` is set, the folder cannot be written,
            another run writes into it, or a package is missing.
        """
        problem = missing("Parquet tables", "parquet", ["pyarrow"])
        if problem is not None:
            raise StageError(problem)
        # Now, and not in the middle of the run, when the first part is written.
        import pyarrow.parquet  # type: ignore[import-untyped]  # noqa: F401

        from tactflow.adapters.tables import Tables

        try:
            for name in TABLES:
                make_folder(self._folder / name)
            self._claim = claim_path(self._folder)
            self._take_over()
        except OSError as error:
            raise StageError(f"{self._folder}: cannot be written into: {error.strerror or error}") from error
        about = {"schema": SCHEMA, **facts(self._sensor, self._control), **texts(self._control)}
        self._tables = Tables(about)
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
        message = encode_message(result, detail=True)
        self._pending.append(message)
        self._bytes += len(message)
        if time.monotonic() - self._flushed >= self.params.flush or self._bytes >= PART_BYTES:
            self._flush()

    def close(self) -> None:
        """Write the last part, and let others write into the folder.

        Raises
        ------
        StageError
            As `write`.
        """
        try:
            self._flush()
        finally:
            self._tables = None
            if self._claim is not None:
                os.close(self._claim)
                self._claim = None

    def _take_over(self) -> None:
        """See what is there: refuse it, remove it, or go on behind it."""
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
        messages, self._pending, self._bytes = self._pending, [], 0
        self._flushed = time.monotonic()
        if not messages or self._tables is None:
            return
        tables = self._tables.build([orjson.loads(message) for message in messages])
        try:
            for name in TABLES:
                self._write_part(name, tables[name])
        except OSError as error:
            hint = "; free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
            raise StageError(
                f"{self._folder}: cannot be written into: {error.strerror or error}; "
                f"the {self._counts['frames']} frames written before are complete; "
                f"not written: {len(messages)}{hint}"
            ) from error
        self._next += 1
        self._counts = {"frames": self._counts["frames"] + len(messages), "parts": self._counts["parts"] + 1}

    def _write_part(self, name: str, table: pa.Table) -> None:
        import pyarrow.parquet as pq

        part = self._folder / name / f"part-{self._next:05d}.parquet"
        unfinished = part.with_name(f"{UNFINISHED}-{part.name}")
        try:
            with unfinished.open("wb") as file:
                pq.write_table(table, file, compression="zstd")
                file.flush()
                # On the disk before it gets its name, so that a power cut leaves no empty part.
                os.fsync(file.fileno())
            unfinished.replace(part)
        except OSError:
            with suppress(OSError):
                unfinished.unlink()
            raise
