"""Result messages from Parquet tables, without the markers, which have a table of their own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactflow.message.columns import Column, frame_columns
from tactflow.system.extras import missing


def read_messages(path: Path) -> Iterator[dict[str, Any]]:
    """The messages in a folder that the sink `parquet` wrote, its folder `frames`, or a file of these.

    Raises ValueError if a package is missing or the tables are not those of results.
    """
    problem = missing("Parquet tables", "parquet", ["pyarrow"])
    if problem is not None:
        raise ValueError(problem)
    import pyarrow as pa  # type: ignore[import-untyped]
    import pyarrow.parquet as pq  # type: ignore[import-untyped]

    folder = path / "frames" if (path / "frames").is_dir() else path
    files = sorted(folder.glob("*.parquet")) if folder.is_dir() else [folder]
    for file in files:
        try:
            with pq.ParquetFile(file) as table:
                if not {"sensor", "seq", "t"} <= set(table.schema_arrow.names):
                    raise ValueError(f"{file.name}: required the table `frames` of the sink parquet")
                for batch in table.iter_batches(1000):
                    yield from (_message(row) for row in batch.to_pylist())
        except pa.ArrowException as error:
            raise ValueError(f"{file.name}: {error}") from None


def _message(row: Mapping[str, Any]) -> dict[str, Any]:
    """A message from a row of `frames`. A part without any value is null."""
    message = _part([column for column in frame_columns() if column.name in row], 0, row) or {}
    skipped = message.get("skipped")
    message["skipped"] = dict(skipped) if skipped else {}
    empty: dict[str, Any] = {"contact": None, "contacts": [], "flow": None, "markers": None}
    return {"schema": "tactflow.frame/1"} | empty | message


def _part(columns: Sequence[Column], depth: int, row: Mapping[str, Any]) -> dict[Any, Any] | None:
    """The part of the message that these columns describe, whose paths are equal up to `depth`."""
    part: dict[Any, Any] = {}
    for key in dict.fromkeys(column.path[depth] for column in columns):
        inside = [column for column in columns if column.path[depth] == key]
        leaf = inside[0] if len(inside[0].path) == depth + 1 else None
        part[key] = row[leaf.name] if leaf else _joined(_part(inside, depth + 1, row))
    return part if any(value is not None for value in part.values()) else None


def _joined(part: dict[Any, Any] | None) -> Any:
    """A list where the keys are indices."""
    if part is None or not all(isinstance(key, int) for key in part):
        return part
    return [part[key] for key in sorted(part)]
