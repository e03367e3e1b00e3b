"""The folder that a batch writes into, `--out`.

    results/NAME-KEY            one for each recording: a folder of Parquet tables, or NAME-KEY.jsonl
    records/KEY.json            what became of it, with its curves and pictures: written last, so that what
                                has one is complete
    ledger/SHARD.jsonl          one line for each recording that a call has looked at
    unfinished/SHARD/           what is being written; claimed by the call that does
    runs.parquet, index.html    all of it, for programs and for people

The ledger saves reading recordings again whose size and time have not changed; it may be lost without harm.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import orjson
from pydantic import BaseModel, Field

from tactflow.batch.digests import digest_of, fingerprint
from tactflow.batch.task import Outcome, decoded
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.files import claim_path, make_folder


class _Picture(BaseModel):
    seq: int
    t: float
    area: float
    jpeg: str = Field(pattern="^[A-Za-z0-9+/=]*$")


class _Record(BaseModel):
    outcome: Outcome
    curve: list[tuple[float, float, float | None, float | None]]
    pictures: list[_Picture]


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it, if it is there. Raises OSError if that cannot be."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


class Folder:
    """One `--out`.

    path : absolute.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results = path / "results"
        self.records = path / "records"
        self.ledgers = path / "ledger"
        self.unfinished = path / "unfinished"

    @contextmanager
    def claimed(self, shard: str) -> Iterator[Path]:
        """Make the folders; gives that for what is not finished, empty, and removes it at the end.

        Raises
        ------
        ConfigError : it cannot be written into, or another call with the same shard is at work in it.
        """
        scratch = self.unfinished / shard
        claim = None
        try:
            for folder in (self.results, self.records, self.ledgers, scratch):
                make_folder(folder)
            claim = claim_path(scratch)
            for left in scratch.iterdir():
                remove(left)
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

    def known(self, pipeline: str) -> dict[str, Outcome]:
        """What the ledgers say: source -> its last outcome, by this pipeline if there is one.

        pipeline : its digest. A line that was cut off counts for nothing.
        """
        found: dict[str, Outcome] = {}
        for path in sorted(self.ledgers.glob("*.jsonl")):
            with path.open("rb") as lines:
                for line in lines:
                    outcome = decoded(line)
                    if outcome is None:
                        continue
                    earlier = found.get(outcome.recording)
                    if earlier is None or _rank(earlier, pipeline) <= _rank(outcome, pipeline):
                        found[outcome.recording] = outcome
        return found

    def record(self, key: str) -> dict[str, Any] | None:
        """What is stored of a finished recording: `outcome`, `curve`, `pictures`.

        None if it is not there, or damaged.
        """
        try:
            found: dict[str, Any] = orjson.loads((self.records / f"{key}.json").read_bytes())
            _Record.model_validate(found)
        except (OSError, ValueError):
            return None
        return found

    def outcome_of(self, key: str, *, verify: bool = False) -> Outcome | None:
        """The outcome of a key for which there is a complete result. verify : as in `is_whole`."""
        record = self.record(key)
        outcome = None if record is None else decoded(orjson.dumps(record.get("outcome")))
        return outcome if outcome is not None and self.is_whole(outcome, verify=verify) else None

    def is_whole(self, outcome: Outcome, *, verify: bool = False) -> bool:
        """Whether the result that an outcome tells of is there as it was written.

        verify : read it even if size and time are as they were.
        """
        if outcome.status != "done" or outcome.result is None or Path(outcome.result).name != outcome.result:
            return False
        path = self.results / outcome.result
        try:
            if not (self.records / f"{outcome.key}.json").is_file():
                return False
            if not verify and fingerprint(path) == outcome.result_file:
                return True
            return digest_of(path) == outcome.result_digest
        except OSError:
            return False


def _rank(outcome: Outcome, pipeline: str) -> tuple[bool, float]:
    return outcome.pipeline == pipeline, outcome.started


class Ledger:
    """Writes down what became of each recording, one line each, at once. Use as a context manager."""

    def __init__(self, folder: Folder, shard: str) -> None:
        self._path = folder.ledgers / f"{shard}.jsonl"

    def __enter__(self) -> Ledger:
        self._file = self._path.open("ab", buffering=0)
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, outcome: Outcome) -> None:
        """Add a line.

        Raises
        ------
        StageError : it cannot be written, as on a full disk.
        """
        # The line end comes first: a line that was cut off shall not spoil the next one.
        line = b"\n" + outcome.encoded()
        try:
            if self._file.write(line) != len(line):
                raise OSError(None, "the disk is full")
        except OSError as error:
            raise StageError(f"{self._path}: cannot be written: {error.strerror or error}") from error
