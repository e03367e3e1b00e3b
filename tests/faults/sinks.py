"""Faults of what sinks write to."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from tactflow.engine.errors import SourceError
from tactflow.sources import open_source
from tests.faults.rig import Seen, array, fill, run, small_disk

THEIRS = "somebody else's"
PICTURE = {"in": {"annotated": "preprocess.image"}}


def look_at_lines(path: Path) -> str:
    """Lines of a file, all of which are complete and in order."""
    text = path.read_text()
    assert text == "" or text.endswith("\n"), "a line is cut off"
    seqs = [json.loads(line)["seq"] for line in text.splitlines()]
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
    "images": Kind("pictures", "folder", PICTURE, look_at_pictures),
    "video .avi": Kind("film.avi", "path", PICTURE, look_at_film),
    "video .mkv": Kind("film.mkv", "path", PICTURE, look_at_film),
    "video .mp4": Kind("film.mp4", "path", PICTURE, look_at_film),
    "record": Kind("press.mcap", "path", {}, look_at_recording),
    "parquet": Kind("tables", "path", {"flush": 0.002}, look_at_tables),
}


def settings_of(kind: str, output: Path) -> dict[str, Any]:
    """The settings of a sink in a pipeline file, under its id."""
    one = KINDS[kind]
    return {
        kind.replace(" .", "_"): {"use": kind.split()[0], one.parameter: str(output), **one.settings},
    }


def _remove(output: Path) -> None:
    output.rename(output.with_name("moved-away"))


def _replace(output: Path) -> None:
    other = output.with_name("other")
    other.write_text(THEIRS)
    other.replace(output)


def _turn_into_pipe(output: Path) -> None:
    pipe = output.with_name("pipe")
    os.mkfifo(pipe)
    if output.is_dir():
        _remove(output)
    pipe.replace(output)


IN_MID_RUN: dict[str, Callable[[Path], None]] = {
    "disk full": lambda output: fill(output.parent),
    "removed": _remove,
    "replaced": _replace,
    "turned into a pipe": _turn_into_pipe,
    "cut to nothing": lambda output: os.truncate(output, 0),
}


def in_mid_run(kind: str, fault: str, folder: Path) -> Seen:
    """Something happens to the output of a sink in the middle of a run."""
    with ExitStack() as stack:
        place = stack.enter_context(small_disk()) if fault == "disk full" else folder
        output = place / KINDS[kind].output
        _, seen = run(
            folder,
            settings_of(kind, output),
            lambda _: IN_MID_RUN[fault](output),
            source=str(array(folder)),
        )
        if fault == "removed":
            kept = "something" if output.exists() else "nothing"
        elif fault == "replaced":
            kept = "the other's file" if output.read_text() == THEIRS else "the other's file was written to"
        elif fault == "turned into a pipe":
            kept = "the pipe" if output.is_fifo() else "a file"
        else:
            kept = _as_said(seen, KINDS[kind].look(output))
    return Seen(seen.exit, seen.said, kept)


def _as_said(seen: Seen, kept: str) -> str:
    """What is there, if it is as much as was said."""
    said = re.search(r"the (\d+ (?:lines|pictures|frames)) written before", seen.said)
    assert said is None or kept.startswith(said[1]), f"{seen.said}, but there are {kept}"
    return kept


def size_limited(kind: str, folder: Path) -> Seen:
    """The system lets no file grow beyond some size (a quota does the same)."""
    output = folder / KINDS[kind].output
    # Below what each of them writes in a run; the pictures are larger than that one by one.
    limit = 10_000 if kind == "jsonl" else 50_000

    def set_limit(_: object) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    source = array(folder)
    try:
        _, seen = run(folder, settings_of(kind, output), set_limit, source=str(source))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    return Seen(seen.exit, seen.said, _as_said(seen, KINDS[kind].look(output)))


def read_only(kind: str, folder: Path) -> Seen:
    """The folder of the output may not be written to."""
    with _read_only_folder(folder) as place:
        _, seen = run(folder, settings_of(kind, place / KINDS[kind].output), source=str(array(folder)))
        return Seen(seen.exit, seen.said, "something" if list(place.iterdir()) else "nothing")


@contextmanager
def _read_only_folder(folder: Path) -> Iterator[Path]:
    if os.geteuid() == 0:
        # Rights do not bind an administrator.
        with small_disk("ro") as place:
            yield place
        return
    place = folder / "locked"
    place.mkdir(mode=0o555)
    yield place


def at_once(kind: str, what: str, folder: Path) -> Seen:
    """What stands at the place of the output when the run begins. what : "a file" or "a pipe"."""
    output = folder / KINDS[kind].output
    inside = {"images": "frame-000000.png", "parquet": "frames/part-00000.parquet"}
    theirs = output / inside[kind] if kind in inside else output
    if what == "a pipe":
        os.mkfifo(output)
    elif output.suffix == "":
        theirs.parent.mkdir(parents=True)
        theirs.write_text(THEIRS)
    else:
        output.write_text(THEIRS)
    _, seen = run(folder, settings_of(kind, output), source=str(array(folder)))
    kept = "the pipe" if output.is_fifo() else "the file" if theirs.read_text() == THEIRS else "ours"
    return Seen(seen.exit, seen.said, kept)


def statistics(option: str, fault: str, folder: Path) -> Seen:
    """A file that the command line asks for, on a disk that is full at the end. fault : of the source too."""
    import io
    from contextlib import redirect_stderr

    from tactflow.cli.main import main
    from tests.faults.rig import At, write_pipeline

    source = folder / "broken.mcap" if "source" in fault else array(folder)
    if "source" in fault:
        shutil.copy(_cut_recording(folder), source)
    file = write_pipeline(folder, {"at": {"use": "tests.faults.rig:At"}}, source=str(source))
    with small_disk() as place, redirect_stderr(io.StringIO()) as said:
        report = place / "report.json"
        At.fault = partial(fill, place)
        code = main(["run", str(file), "--quiet", option, str(report)])
        text = report.read_text()
    return Seen(code, said.getvalue().strip(), f"{len(text)} bytes")


def _cut_recording(folder: Path) -> Path:
    """A recording whose 61st frame and all after it are damaged."""
    path = folder / "whole.mcap"
    run(folder, {"record": {"path": str(path), "preview": 0}}, source=str(array(folder)))
    data = bytearray(path.read_bytes())
    data[len(data) * 6 // 10] ^= 1
    path.write_bytes(data)
    return path
