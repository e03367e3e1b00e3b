"""Write the table of all runs, for programs, and the report page, for people."""

from __future__ import annotations

import base64
import functools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import orjson
from numpy.typing import NDArray

from tactflow.batch.recordings import Recording
from tactflow.batch.store import Format, Outcome, Store
from tactflow.engine.errors import ConfigError, StageError
from tactflow.report import COLORS, Html, Section, Table, figure, link, mark, picture, write_report
from tactflow.system.extras import missing
from tactflow.system.files import completed

MAX_DETAILS = 300
"""Recordings shown in detail: each takes 50 ms to draw and 60 kB of the page, which shall open quickly."""
NOT_IN_TABLE = {"pipeline", "recording_is", "result_is", "disk_full"}
"""Internal fields of an outcome."""
_TYPES = {"int": "int64", "float": "float64"}
"""Python type -> Arrow type; all others are strings."""

Runs = Sequence[tuple[Recording, Outcome]]


def require_pyarrow() -> None:
    """Raise ConfigError with installation instructions if pyarrow is missing."""
    if problem := missing("Parquet tables", "parquet", ["pyarrow"]):
        raise ConfigError(f"{problem}; or use --format jsonl, which needs no package")


def write_runs(store: Store, runs: Runs, format_: Format) -> Path:
    """Write the table of runs, overwriting an earlier one; return its path. Raises StageError."""
    path = store.path / f"runs.{format_}"
    columns = [field for field in fields(Outcome) if field.name not in NOT_IN_TABLE]
    rows = [{column.name: getattr(outcome, column.name) for column in columns} for _, outcome in runs]
    try:
        with completed(path) as partial:
            if format_ == "jsonl":
                partial.write_bytes(b"".join(orjson.dumps(row) + b"\n" for row in rows))
            else:
                import pyarrow as pa  # type: ignore[import-untyped]
                import pyarrow.parquet as pq  # type: ignore[import-untyped]

                types = [(c.name, getattr(pa, _TYPES.get(str(c.type), "string"))()) for c in columns]
                pq.write_table(pa.Table.from_pylist(rows, schema=pa.schema(types)), partial)
    except OSError as error:
        raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def write_page(store: Store, runs: Runs, title: str) -> Path:
    """Write `index.html`, overwriting an earlier one; return its path. Raises StageError."""
    ordered = sorted(runs, key=lambda run: ("failed", "done", "not done").index(run[1].status))
    done = [outcome for _, outcome in runs if outcome.status == "done"]
    failed = sum(outcome.status == "failed" for _, outcome in runs)
    text = (
        f"{len(done)} done, {failed} failed, {len(runs) - len(done) - failed} not done; "
        f"{sum(o.frames for o in done)} frames, {sum(o.contacts for o in done)} contacts; "
        f"{sum(o.took_s for o in done):.0f} s of work"
    )
    if problem := missing("plots", "plot", ["matplotlib"]):
        text += f"\n\nNo plots: {problem}"
    shown = ordered[:MAX_DETAILS]
    if len(shown) < len(ordered):
        text += f"\n\nDetails of {len(shown)} of {len(ordered)} recordings, failed ones first."
    try:
        sections = [Section("Runs", tables=[_table(ordered)]), *(_details(store, *run) for run in shown)]
    except OSError as error:
        raise StageError(f"{store.records}: cannot be used: {error.strerror or error}") from error
    return write_report(store.path / "index.html", title, sections, text)


def _table(runs: Runs) -> Table:
    columns = [
        *("recording", "status", "frames", "duration, s", "frames/s", "contacts"),
        *("touching, %", "largest contact, px²", "result"),
    ]
    rows: list[list[Any]] = []
    for recording, outcome in runs:
        row: list[Any] = [recording.name, mark(outcome.status, outcome.status == "done")]
        if outcome.status == "done":
            touching = 100.0 * outcome.touching_frames / max(1, outcome.frames)
            rate = outcome.frames / outcome.took_s if outcome.took_s else None
            row += [outcome.frames, outcome.duration_s, rate, outcome.contacts, touching]
            row += [outcome.largest_area_px2, link("open", quote(str(outcome.result)))]
        rows.append(row + [None] * (len(columns) - len(row)))
    return Table(columns, rows)


def _details(store: Store, recording: Recording, outcome: Outcome) -> Section:
    """Error of a failed recording, or plot and pictures of a finished one."""
    path = recording.source if recording.source != recording.name else None
    text = "\n\n".join(filter(None, (outcome.error, outcome.warnings, path)))
    pictures = [Html(store.preview_html(recording, _preview))] if outcome.status == "done" else []
    return Section(recording.name, text, pictures)


def _preview(preview: bytes) -> str:
    """Plot and pictures of `Summary.preview` as HTML; only the pictures without matplotlib."""
    content = orjson.loads(preview)
    pictures = [picture(base64.b64decode(jpeg), f"{t:.2f} s") for t, jpeg in content["pictures"]]
    with suppress(ConfigError):
        # JSON has null for NaN.
        pictures.insert(0, picture(_plot(np.array(content["points"], float).reshape(-1, 4))))
    return "".join(pictures)


@functools.cache
def _axes() -> tuple[Any, Any]:
    """A figure reused for all recordings: a new one for each takes three times as long (0.2 s)."""
    drawing, axes = figure(3, 1, size=(4.2, 2.8), sharex=True)
    for axis, label, color in zip(axes, ("area, px²", "flow, px", "angle, °"), COLORS[:3], strict=True):
        axis.plot([], [], color=color)
        axis.set_ylabel(label, fontsize=8)
        axis.tick_params(labelsize=8)
    axes[2].set_xlabel("time, s", fontsize=8)
    drawing.align_ylabels()
    # Freeze the layout with the widest labels expected, px^2.
    axes[0].set_ylim(0, 90_000)
    drawing.draw_without_rendering()
    drawing.set_layout_engine("none")
    return drawing, axes


def _plot(points: NDArray[np.float64]) -> Any:
    """Plot the points (N, 4) of a recording."""
    drawing, axes = _axes()
    # An axis that turns past 90 degrees continues at -90: no line is drawn between the two.
    jumps = np.flatnonzero(np.abs(np.diff(points[:, 3])) > 90.0) + 1
    points = np.insert(points, jumps, np.nan, axis=0)
    for axis, curve in zip(axes, points.T[1:], strict=True):
        axis.lines[0].set_data(points[:, 0], curve)
        axis.relim()
        axis.autoscale(axis="both")
    axes[2].set_ylim(-90, 90)
    return drawing
