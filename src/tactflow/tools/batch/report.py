"""Write the table of all runs, for programs, and the report page, for people."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
import orjson

from tactflow.engine.errors import ConfigError
from tactflow.system.extras import missing
from tactflow.system.files import completed
from tactflow.tools.batch.recordings import Recording
from tactflow.tools.batch.store import Format, Outcome, Store
from tactflow.tools.batch.summary import TRACE_LABELS
from tactflow.tools.page import Html, Section, marked, page, plot, series, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOT_IN_TABLE = {"pipeline", "recording_is", "result_is", "disk_full", "pictures", "trace"}
"""Internal fields of an outcome."""
COLUMNS = (
    *("recording", "status", "frames", "duration, s", "frames/s", "contacts", "touching, %"),
    *("largest contact, px²", "result", "over time", "largest contacts, or what went wrong"),
)
"""Headings of the page."""
TRACE_WIDTH_PX = 240
"""Width of the plot of a recording, CSS pixels."""
_TYPES = {"int": "int64", "float": "float64"}
"""Python type -> Arrow type; all others are strings."""

Runs = Sequence[tuple[Recording, Outcome]]


def chosen_format(requested: Format | None) -> tuple[Format, Sequence[str]]:
    """The requested format, or else Parquet if pyarrow is installed, or else CSV; and a note about that.

    Raises ConfigError with installation instructions if Parquet is requested and pyarrow is missing.
    """
    problem = missing("Parquet tables", "parquet", ["pyarrow"])
    if requested is not None and not (requested == "parquet" and problem):
        return requested, ()
    if requested is not None:
        raise ConfigError(f"{problem}; or use --format csv or jsonl, which need no package")
    if problem:
        return "csv", (f"results are written as CSV; {problem}",)
    return "parquet", ()


def write_runs(store: Store, runs: Runs, format_: Format) -> Path:
    """Write the table of runs, overwriting an earlier one; return its path."""
    path = store.path / f"runs.{format_}"
    columns = [field for field in fields(Outcome) if field.name not in NOT_IN_TABLE]
    rows = [{column.name: getattr(outcome, column.name) for column in columns} for _, outcome in runs]
    with completed(path) as partial:
        if format_ == "jsonl":
            partial.write_bytes(b"".join(orjson.dumps(row) + b"\n" for row in rows))
        elif format_ == "csv":
            with partial.open("w", newline="", encoding="utf-8") as file:
                table = csv.DictWriter(file, [column.name for column in columns], lineterminator="\n")
                table.writeheader()
                table.writerows(rows)
        else:
            import pyarrow as pa  # type: ignore[import-untyped]
            import pyarrow.parquet as pq  # type: ignore[import-untyped]

            types = [(c.name, getattr(pa, _TYPES.get(str(c.type), "string"))()) for c in columns]
            pq.write_table(pa.Table.from_pylist(rows, schema=pa.schema(types)), partial)
    return path


def write_page(store: Store, runs: Runs, title: str) -> Path:
    """Write `index.html`, overwriting an earlier one; return its path."""
    path = store.path / "index.html"
    ordered = sorted(runs, key=lambda run: ("failed", "done", "not done").index(run[1].status))
    done = [outcome for _, outcome in runs if outcome.status == "done"]
    failed = sum(outcome.status == "failed" for _, outcome in runs)
    text = (
        f"{len(done)} done, {failed} failed, {len(runs) - len(done) - failed} not done; "
        f"{sum(o.frames for o in done)} frames, {sum(o.contacts for o in done)} contacts; "
        f"{sum(o.took_s for o in done):.0f} s of work"
    )
    rows = [list(_cells(store, *run)) for run in ordered]
    written = page(title, [Section("", body=[table(COLUMNS, rows, sortable=True)])], text)
    with completed(path) as partial:
        partial.write_text(written, encoding="utf-8")
    return path


def _trace(outcome: Outcome) -> Html:
    """A small plot of what the recording has of area, flow and force over time."""
    values = {name: np.array(outcome.trace.get(name, ()), np.float64) for name in ("t", *TRACE_LABELS)}
    shown = [name for name in TRACE_LABELS if np.isfinite(values[name]).any()]
    if not shown:
        return Html("")

    def draw(figure: Figure) -> None:
        for index, name in enumerate(shown):
            axes = figure.add_subplot(len(shown), 1, index + 1)
            axes.plot(values["t"], values[name], color=series(index), linewidth=1)
            axes.set_ylabel(TRACE_LABELS[name], fontsize=7)
            axes.tick_params(labelsize=7, labelbottom=name == shown[-1])

    return plot(draw, width=TRACE_WIDTH_PX, height=60 * len(shown) + 20)


def _cells(store: Store, recording: Recording, outcome: Outcome) -> Iterator[str]:
    """Cells of a row."""
    yield recording.name
    yield marked(outcome.status, {"done": "good", "failed": "bad"}.get(outcome.status, "quiet"))
    if outcome.status == "done":
        yield str(outcome.frames)
        yield f"{outcome.duration_s:.2f}"
        yield f"{outcome.frames / outcome.took_s:.0f}" if outcome.took_s else ""
        yield str(outcome.contacts)
        yield f"{100.0 * outcome.touching_frames / max(1, outcome.frames):.1f}"
        yield f"{outcome.largest_area_px2:.0f}"
        yield Html(f'<a href="{escape(quote(str(outcome.result)))}">open</a>')
        yield _trace(outcome)
    else:
        yield from [""] * 8
    remarks = "\n".join(filter(None, (outcome.error, outcome.warnings)))
    pictures = zip(store.pictures(recording, len(outcome.pictures)), outcome.pictures, strict=True)
    addresses = ((escape(quote(file.relative_to(store.path).as_posix())), t) for file, t in pictures)
    images = (f'<img loading="lazy" src="{address}" title="{t:.2f} s">' for address, t in addresses)
    yield Html("".join(images) + escape(remarks).replace("\n", "<br>"))
