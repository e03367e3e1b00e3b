"""The folder that a batch writes, `--out`.

    results/NAME            of each recording: a folder of Parquet tables, or NAME.jsonl
    records/NAME.json       its outcome, written after the result
    records/NAME.html       its plot and pictures, for the page
    unfinished/SHARD/       what is being written; removed at the end
    runs.parquet, index.html

A recording is done if its record says so, its result has the size and time that the record names, and neither
the recording nor the pipeline has changed since.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import orjson
from pydantic import TypeAdapter

from tactflow.batch.recordings import Recording
from tactflow.engine.errors import ConfigError
from tactflow.system.files import claim_path, completed, make_folder

Format = Literal["parquet", "jsonl"]
Status = Literal["done", "failed", "not done"]
Fingerprint = tuple[int, int]
"""Size, bytes, and time of the last change, ns."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a recording: a row of the table of runs.

    error : why it failed. frames : processed. duration_s : time of the last frame. contacts : how often
    something touched the gel; touching_frames : in how many frames. largest_area_px2 : of a contact.
    started_unix, took_s : when the work began, and how long it took. worker : host and process. result : path
    below `--out`. warnings : one a line. tactflow : version. pipeline : `pipeline_digest`. recording_is,
    result_is : fingerprints. disk_full : whether it failed for that.
    """

    recording: str
    name: str
    status: Status
    error: str | None = None
    frames: int = 0
    dropped: int = 0
    duration_s: float = 0.0
    contacts: int = 0
    touching_frames: int = 0
    largest_area_px2: float = 0.0
    started_unix: float = 0.0
    took_s: float = 0.0
    worker: str = ""
    result: str | None = None
    warnings: str | None = None
    tactflow: str = ""
    pipeline: str = ""
    recording_is: Fingerprint | None = None
    result_is: Fingerprint | None = None
    disk_full: bool = False


_OUTCOME = TypeAdapter(Outcome)


def fingerprint(path: Path) -> Fingerprint:
    """Of a file, or of all files in a folder: total size and latest change.

    Raises OSError if it is not there, or if one of the files is a pipe or a device: reading it would not end.
    """
    files = [path]
    if path.is_dir():
        files = [Path(place, name) for place, _, names in os.walk(path) for name in names]
    found = []
    for file in files:
        found.append(file.stat())
        if not stat.S_ISREG(found[-1].st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(file))
    return sum(f.st_size for f in found), max((f.st_mtime_ns for f in found), default=0)


class Store:
    """One `--out`. path : absolute."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.records = path / "records"

    @contextmanager
    def claimed(self, shard: str) -> Iterator[Path]:
        """Make the folders, and an empty one for unfinished work, which is removed at the end.

        Raises
        ------
        ConfigError : it cannot be written into, or another call works on the same shard.
        """
        scratch = self.path / "unfinished" / shard
        claim = None
        try:
            for folder in (self.path / "results", self.records, scratch):
                make_folder(folder)
            claim = claim_path(scratch)
            for path in scratch.iterdir():
                remove(path)
        except BlockingIOError:
            raise ConfigError(
                f"--out {self.path}: another tactflow batch is at work in it; wait for it, or give each its "
                "part with --shard 1/2, --shard 2/2"
            ) from None
        except OSError as error:
            raise ConfigError(f"--out {self.path}: cannot be written into: {error.strerror}") from None
        try:
            yield scratch
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
            if claim is not None:
                os.close(claim)

    def outcome(self, recording: Recording) -> Outcome | None:
        """The last outcome of a recording; None if there is none, or its record is damaged."""
        try:
            return _OUTCOME.validate_json((self.records / f"{file_name(recording)}.json").read_bytes())
        except (OSError, ValueError):
            return None

    def is_done(self, recording: Recording, outcome: Outcome, pipeline: str) -> bool:
        """Whether the result is there, and neither recording nor pipeline has changed since."""
        if outcome.status != "done" or outcome.pipeline != pipeline or outcome.result is None:
            return False
        try:
            same = recording.path is None or fingerprint(recording.path) == outcome.recording_is
            return same and fingerprint(self.path / outcome.result) == outcome.result_is
        except OSError:
            return False

    def save(self, recording: Recording, outcome: Outcome, preview: str = "") -> None:
        """Write the record of a recording. preview : HTML for the page. Raises OSError."""
        name = file_name(recording)
        for file, content in (
            (f"{name}.html", preview.encode()),
            (f"{name}.json", orjson.dumps(asdict(outcome))),
        ):
            with completed(self.records / file) as partial:
                partial.write_bytes(content)

    def preview(self, recording: Recording) -> str:
        """Plot and pictures of a recording as HTML; empty if there are none."""
        path = self.records / f"{file_name(recording)}.html"
        return path.read_text(encoding="utf-8") if path.is_file() else ""


def file_name(recording: Recording) -> str:
    """Name of the files of a recording: readable, and the same in every call.

    >>> file_name(Recording("/data/press 1.avi", "press 1.avi"))
    'press_1.avi-3db9295a358c'
    """
    path = recording.path
    text = recording.source.removeprefix("sim:") if path is None else path.name
    safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in text).lstrip(".")
    # 255 bytes is the longest name of a file; a letter takes four at most.
    return f"{safe[:50]}-{hashlib.sha256(recording.source.encode()).hexdigest()[:12]}"


def remove(path: Path) -> None:
    """Remove a file, or a folder with its content, if it is there. Raises OSError."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
