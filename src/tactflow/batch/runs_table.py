"""`runs.parquet` or `runs.jsonl`: a row for each recording of a batch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import orjson

from tactflow.batch.recordings import Recording
from tactflow.batch.task import Format, Outcome
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.extras import missing
from tactflow.system.files import completed

_ROWS = 10_000
"""Rows that are written at once. Chosen by hand: some 10 MB."""

COLUMNS = {
    "recording": "string",
    "name": "string",
    "status": "string",
    "error": "string",
    "frames": "int64",
    "dropped": "int64",
    "duration_s": "float64",
    "contacts": "int64",
    "touching_frames": "int64",
    "largest_area_px2": "float64",
    "started_unix": "float64",
    "took_s": "float64",
    "worker": "string",
    "attempts": "int64",
    "result": "string",
    "result_bytes": "int64",
    "result_sha256": "string",
    "input_bytes": "int64",
    "input_sha256": "string",
    "pipeline_sha256": "string",
    "key": "string",
    "warnings": "string",
    "versions": "string",
}
"""Column -> type, as Arrow calls it."""


@dataclass(frozen=True, slots=True)
class Row:
    """One recording and what became of it; None: nobody has looked at it yet."""

    recording: Recording
    outcome: Outcome | None


def require_pyarrow() -> None:
    """Raises ConfigError with what to do where pyarrow is missing."""
    problem = missing("Parquet tables", "parquet", ["pyarrow"])
    if problem is not None:
        raise ConfigError(f"{problem}; or give --format jsonl, which needs no package")


def values(row: Row) -> dict[str, Any]:
    """A row as plain values, by column."""
    outcome = row.outcome
    if outcome is None:
        blank: dict[str, Any] = dict.fromkeys(COLUMNS)
        return blank | {"recording": row.recording.source, "name": row.recording.name, "status": "not done"}
    return {
        "recording": row.recording.source,
        "name": row.recording.name,
        "status": outcome.status,
        "error": outcome.error,
        "frames": outcome.frames,
        "dropped": outcome.dropped,
        "duration_s": outcome.duration,
        "contacts": outcome.contacts,
        "touching_frames": outcome.touching,
        "largest_area_px2": outcome.largest,
        "started_unix": outcome.started,
        "took_s": outcome.seconds,
        "worker": outcome.worker,
        "attempts": outcome.attempts,
        "result": None if outcome.result is None else f"results/{outcome.result}",
        "result_bytes": None if outcome.result_file is None else outcome.result_file.size,
        "result_sha256": outcome.result_digest or None,
        "input_bytes": None if outcome.input is None else outcome.input.size,
        "input_sha256": outcome.input_digest or None,
        "pipeline_sha256": outcome.pipeline or None,
        "key": outcome.key or None,
        "warnings": "\n".join(outcome.notes) or None,
        "versions": ", ".join(f"{name} {number}" for name, number in outcome.versions.items()) or None,
    }


def write_runs(folder: Path, rows: Iterable[Row], format_: Format) -> Path:
    """Write the table beside the results, in place of an earlier one; returns its path.

    Raises
    ------
    StageError : it cannot be written.
    """
    path = folder / f"runs.{format_}"
    try:
        with completed(path) as partial:
            (_write_parquet if format_ == "parquet" else _write_lines)(partial, rows)
    except OSError as error:
        raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def _write_lines(path: Path, rows: Iterable[Row]) -> None:
    with path.open("wb") as file:
        for row in rows:
            file.write(orjson.dumps(values(row)) + b"\n")


def _write_parquet(path: Path, rows: Iterable[Row]) -> None:
    import pyarrow as pa  # type: ignore[import-untyped]
    import pyarrow.parquet as pq  # type: ignore[import-untyped]

    schema = pa.schema([(name, getattr(pa, kind)()) for name, kind in COLUMNS.items()])
    with pq.ParquetWriter(path, schema) as writer:
        for group in _groups(rows):
            writer.write_table(pa.Table.from_pylist([values(row) for row in group], schema=schema))


def _groups(rows: Iterable[Row]) -> Iterator[Sequence[Row]]:
    group: list[Row] = []
    for row in rows:
        group.append(row)
        if len(group) == _ROWS:
            yield group
            group = []
    yield group
