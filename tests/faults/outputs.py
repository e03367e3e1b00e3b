"""What sinks write, and what is left of it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from tactflow.engine.errors import SourceError
from tactflow.sources import open_source

PICTURE = {"in": {"annotated": "preprocess.image"}}


def look_at_lines(path: Path) -> str:
    """Lines of a file, all of which are complete and in order."""
    text = path.read_text()
    assert text == "" or text.endswith("\n"), "a line is cut off"
    seqs = [json.loads(line)["seq"] for line in text.splitlines()]
    assert seqs == sorted(set(seqs))
    return f"{len(seqs)} lines"


def look_at_rows(path: Path) -> str:
    """Rows of a table, all of which are complete and in order."""
    text = path.read_text()
    assert text == "" or text.endswith("\n"), "a row is cut off"
    header, *rows = csv.reader(text.splitlines()) if text else ([],)
    assert {len(row) for row in rows} <= {len(header)}
    seqs = [int(row[header.index("seq")]) for row in rows]
    assert seqs == sorted(set(seqs))
    return f"{len(seqs)} lines"


def look_at_pictures(folder: Path) -> str:
    """Pictures of a folder, all of which can be read to the last row."""
    files = sorted(folder.glob("frame-*"))
    assert all(cv2.imread(str(file)) is not None for file in files)
    return f"{len(files)} pictures"


def look_at_film(path: Path) -> str:
    """Frames of a film, as a player shows them."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    frames = 0
    while capture.grab():
        frames += 1
    capture.release()
    return f"{frames} frames can be played" if frames else "no frame can be played"


def look_at_recording(path: Path) -> str:
    """Frames of a recording, with all their pixels."""
    try:
        source = open_source(str(path))
        frames = len(list(iter(source.read, None)))
    except SourceError as error:
        return str(error).replace(str(path), "the file")
    source.close()
    return f"{frames} frames can be played"


def look_at_tables(folder: Path) -> str:
    """Frames of the tables, whose parts are all whole and whose other rows belong to them."""
    import pyarrow.parquet as pq

    if not any((folder / "frames").glob("part-*")):
        return "0 frames"
    frames, contacts, markers = (pq.read_table(folder / name) for name in ("frames", "contacts", "markers"))
    seqs = frames["seq"].to_pylist()
    assert seqs == sorted(set(seqs))
    assert set(contacts["seq"].to_pylist()) <= set(markers["seq"].to_pylist()) | set(seqs)
    return f"{len(seqs)} frames can be read"


@dataclass(frozen=True)
class Kind:
    """A sink that writes. parameter : names the output. settings : all others. look : sees what is there."""

    output: str
    parameter: str
    settings: dict[str, Any]
    look: Callable[[Path], str]


KINDS = {
    "jsonl": Kind("out.jsonl", "path", {"flush": 0}, look_at_lines),
    "csv": Kind("out.csv", "path", {"flush": 0}, look_at_rows),
    "images": Kind("pictures", "folder", PICTURE, look_at_pictures),
    "video .avi": Kind("film.avi", "path", PICTURE, look_at_film),
    "video .mkv": Kind("film.mkv", "path", PICTURE, look_at_film),
    "video .mp4": Kind("film.mp4", "path", PICTURE, look_at_film),
    "record": Kind("press.mcap", "path", {}, look_at_recording),
    "parquet": Kind("tables", "path", {"flush": 0.002}, look_at_tables),
}


def settings_of(kind: str, output: Path) -> dict[str, dict[str, Any]]:
    """The settings of a sink in a pipeline file, under its id."""
    sink = KINDS[kind]
    settings = {"use": kind.split()[0], sink.parameter: str(output), **sink.settings}
    return {kind.replace(" .", "_"): settings}
