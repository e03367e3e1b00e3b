"""The output folder of a batch, `--out`.

    results/NAME            per recording: a folder of Parquet tables, NAME.csv or NAME.jsonl
    records/NAME.json       its outcome, written after the result
    records/NAME.0.jpg ...  its largest contacts, which the page shows
    unfinished/SHARD/       results being written; removed at the end
    runs.parquet, index.html

A recording is done if its record says so, the result has the size and modification time in the record, and
neither the recording nor the pipeline has changed since.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import orjson
from pydantic import TypeAdapter

from tactflow.engine.errors import ConfigError
from tactflow.system.files import completed, lock_folder, make_folder
from tactflow.tools.batch.recordings import Recording

Format = Literal["parquet", "csv", "jsonl"]
Status = Literal["done", "failed", "not done"]
Fingerprint = tuple[int, int]
"""Size, bytes, and modification time, ns."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of processing a recording: a row of the table of runs.

    Attributes
    ----------
    error : reason for a failure.
    frames : number processed.
    duration_s : time of the last frame.
    contacts : number of separate touches;
    touching_frames : frames with contact.
    largest_area_px2 : of all contacts.
    started_unix, took_s : start time and processing time.
    worker : host and process.
    result : path relative to `--out`.
    warnings : one per line.
    tactflow : version.
    pipeline : `pipeline_digest`.
    recording_is, result_is : fingerprints.
    disk_full : whether a full disk caused the failure.
    pictures : times of its pictures, s.
    trace : a few quantities over time, see `Trace`.
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
    pictures: tuple[float, ...] = ()
    trace: dict[str, list[float | None]] = field(default_factory=dict)


_OUTCOME = TypeAdapter(Outcome)


def fingerprint(path: Path) -> Fingerprint:
    """Total size and latest modification time of a file or of all files in a folder.

    Raises OSError if the path does not exist.
    """
    files = [path]
    if path.is_dir():
        files = [Path(parent, name) for parent, _, names in os.walk(path) for name in names]
    stats = [file.stat() for file in files]
    return sum(s.st_size for s in stats), max((s.st_mtime_ns for s in stats), default=0)


class Store:
    """The output folder of a batch.

    Parameters
    ----------
    path : absolute.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.records = path / "records"

    @contextmanager
    def claimed(self, shard: str) -> Iterator[Path]:
        """Lock the shard and create the folders; yields an empty one for unfinished work, removed at the end.

        Raises
        ------
        ConfigError : the folder is not writable, or another call has locked the same shard.
        """
        scratch = self.path / "unfinished" / shard
        claim = None
        try:
            for folder in (self.path / "results", self.records, scratch):
                make_folder(folder)
            claim = lock_folder(scratch)
            for path in scratch.iterdir():
                remove(path)
        except BlockingIOError:
            raise ConfigError(
                f"--out {self.path}: another tactflow batch is using it; wait for it to finish, or divide "
                "the recordings with --shard 1/2, --shard 2/2"
            ) from None
        except OSError as error:
            raise ConfigError(f"--out {self.path}: is not writable: {error.strerror}") from None
        try:
            yield scratch
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
            if claim is not None:
                os.close(claim)

    def outcome(self, recording: Recording) -> Outcome | None:
        """The last outcome of a recording; None without a record, or if it is damaged."""
        try:
            return _OUTCOME.validate_json(self._file(recording, "json").read_bytes())
        except (OSError, ValueError):
            return None

    def is_done(self, recording: Recording, outcome: Outcome, pipeline: str) -> bool:
        """Whether the result exists and neither recording nor pipeline has changed since."""
        if outcome.status != "done" or outcome.pipeline != pipeline or outcome.result is None:
            return False
        try:
            same = recording.path is None or fingerprint(recording.path) == outcome.recording_is
            return same and fingerprint(self.path / outcome.result) == outcome.result_is
        except OSError:
            return False

    def save(self, recording: Recording, outcome: Outcome, pictures: Sequence[bytes] = ()) -> None:
        """Write the record of a recording, after its pictures (JPEG). Raises OSError."""
        files = self.pictures(recording, len(pictures))
        contents = [*zip(files, pictures, strict=True)]
        for path, content in [*contents, (self._file(recording, "json"), orjson.dumps(asdict(outcome)))]:
            with completed(path) as partial:
                partial.write_bytes(content)

    def pictures(self, recording: Recording, count: int) -> list[Path]:
        """Files of the pictures of a recording."""
        return [self._file(recording, f"{number}.jpg") for number in range(count)]

    def _file(self, recording: Recording, suffix: str) -> Path:
        return self.records / f"{file_name(recording)}.{suffix}"


def file_name(recording: Recording) -> str:
    """Base name of a recording's files: readable and reproducible.

    >>> file_name(Recording("/data/press 1.avi", "press 1.avi"))
    'press_1.avi-3db9295a358c'
    """
    path = recording.path
    text = recording.source.removeprefix("sim:") if path is None else path.name
    safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in text).lstrip(".")
    # File names are limited to 255 bytes; a letter takes up to four.
    return f"{safe[:50]}-{hashlib.sha256(recording.source.encode()).hexdigest()[:12]}"


def remove(path: Path) -> None:
    """Remove a file or a folder with its content, if it exists. Raises OSError."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
