"""JSON Lines: one result message per frame, one line each."""

from __future__ import annotations

import errno
import json
import logging
import os
import stat
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from pydantic import Field, model_validator

from tactflow.engine.contract import Output, Sink, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Tick
from tactflow.files import expanded, lead_nowhere, make_folder, taken_away
from tactflow.message import Results, encode_message

log = logging.getLogger("tactflow")


class Jsonl(Sink):
    """Writes result messages to a file or to standard output, complete lines only.

    Lines reach a file at least every `flush` seconds of frames and at the end, and standard output at once.
    When the reader of standard output goes away, the sink falls silent and wants nothing more.
    """

    class Params(StageParams):
        """Where to write, and what to do with a file that is there already."""

        path: str = Field(
            "results.jsonl", min_length=1, description="file, relative to the current directory; - is stdout"
        )
        overwrite: bool = Field(False, description="replace an existing file")
        append: bool = Field(False, description="continue an existing file")
        flush: float = Field(
            0.5, ge=0, description="longest time that lines wait before they reach the file, s; 0 is at once"
        )
        detail: bool = Field(
            False, description="also write confidence, standard errors, rotation, divergence, residual"
        )

        @model_validator(mode="after")
        def _one_of_both(self) -> Jsonl.Params:
            if self.overwrite and self.append:
                raise ValueError("overwrite and append exclude each other")
            return self

    def __init__(self, params: Params) -> None:
        """Prepare; nothing is opened yet."""
        super().__init__(params)
        self._name = "standard output" if params.path == "-" else params.path
        self.description = self._name
        self._file: BinaryIO | None = None
        self._pending: list[bytes] = []
        self._flushed = 0.0
        self._complete: int | None = None
        self._lines = 0

    @classmethod
    def outputs(cls, params: Jsonl.Params) -> Sequence[Output]:
        """The file, or none for standard output."""
        if params.path == "-":
            return ()
        keeps = not (params.overwrite or params.append)
        return (Output(expanded(params.path), "file", "path", refuses_existing=keeps),)

    @classmethod
    def on_restart(cls, params: Jsonl.Params) -> Jsonl.Params:
        """It continues its file."""
        return params.changed(overwrite=False, append=True)

    def open(self) -> None:
        """Open or create the file, and its folder.

        Raises
        ------
        StageError
            If the file exists and neither `overwrite` nor `append` is set, or it cannot be written.
        """
        if self.params.path == "-":
            self._file = sys.stdout.buffer
            return
        path = expanded(self.params.path)
        try:
            make_folder(path.parent)
            self._file = self._open_file(path)
        except OSError as error:
            raise StageError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._flushed = time.monotonic()

    def _open_file(self, path: Path) -> BinaryIO:
        regular = not path.exists() or stat.S_ISREG(path.stat().st_mode)
        if not regular:
            return path.open("wb", buffering=0)
        if path.exists() and path.stat().st_size > 0 and not (self.params.overwrite or self.params.append):
            raise StageError(
                f"{path}: this file exists; set overwrite: true to replace it, append: true to continue it, "
                "or give another path"
            )
        replace = os.O_TRUNC if self.params.overwrite else 0
        create = os.O_CREAT if path.exists() else os.O_CREAT | os.O_EXCL
        # At the end whatever happens: where another program has cut the file, no gap of NULs may follow.
        flags = os.O_RDWR | os.O_APPEND | getattr(os, "O_BINARY", 0) | replace | create
        file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
        try:
            self._complete = _continue_at(file, path) if self.params.append and file.readable() else 0
        except BaseException:
            file.close()
            raise
        return file

    def wants(self) -> bool:
        """False once the reader of standard output has gone away."""
        return self._file is not None

    def counters(self) -> dict[str, int]:
        """lines : written so far."""
        return {"lines": self._lines}

    def write(self, tick: Tick, results: Results) -> None:
        """Add one line.

        Raises
        ------
        StageError
            If the file cannot be written, for instance because the disk is full. The file then ends with the
            last line that fitted.
        """
        if self._file is None:
            return
        self._pending.append(encode_message(tick, results, detail=self.params.detail))
        now = time.monotonic()
        if self.params.path == "-" or now - self._flushed >= self.params.flush:
            self._flushed = now
            self._flush()

    def close(self) -> None:
        """Write what is left and close the file."""
        try:
            self._flush()
            if self._complete is not None and self._file is not None:
                self._check_file(0)
        finally:
            if self._file is not None and self.params.path != "-":
                self._file.close()
            self._file = None

    def _flush(self) -> None:
        if self._file is None or not self._pending:
            return
        lines, self._pending = self._pending, []
        data = memoryview(b"\n".join([*lines, b""]))
        written = 0
        try:
            # An unbuffered file may take only a part, and says why at the next attempt.
            while written < len(data):
                written += self._file.write(data[written:])
            self._file.flush()
        except OSError as error:
            if self.params.path == "-" and error.errno in (errno.EPIPE, errno.ECONNRESET):
                self._reader_left()
                return
            self._cut_at_complete_line(data[:written])
            raise StageError(
                f"{self._name}: cannot be written: {error.strerror or error}; "
                f"the {self._lines} lines written before are complete"
            ) from error
        self._lines += len(lines)
        if self._complete is not None:
            self._check_file(len(data))

    def _check_file(self, written: int) -> None:
        """Find out that others have removed, replaced or cut the file.

        written : bytes since the last look.
        """
        assert self._file is not None
        assert self._complete is not None
        path, ours = expanded(self.params.path), os.fstat(self._file.fileno())
        what = taken_away(path, ours)
        expected, self._complete = self._complete + written, ours.st_size
        if what is not None:
            self._complete = None
            raise StageError(
                f"{path}: was {what} by another program while the run wrote to it; {self._lines} lines are "
                "not in it"
            )
        if ours.st_size < expected:
            gone = expected - ours.st_size
            log.warning("%s: was cut by another program: %d bytes that were written are gone", path, gone)

    def _cut_at_complete_line(self, written: memoryview) -> None:
        """After a failed write, leave the file with complete lines only."""
        kept = bytes(written).rfind(b"\n") + 1
        self._lines += bytes(written).count(b"\n")
        if self._file is not None and self._complete is not None:
            self._complete = os.fstat(self._file.fileno()).st_size - len(written) + kept
            self._file.truncate(self._complete)

    def _reader_left(self) -> None:
        log.debug("standard output was closed by its reader")
        self._file = None
        lead_nowhere(sys.stdout)


def _continue_at(file: BinaryIO, path: Path) -> int:
    """Seek to the end of the last complete line, completing or cutting off what follows it; its offset."""
    end = file.seek(0, os.SEEK_END)
    tail = b""
    start = end
    while start > 0 and b"\n" not in tail:
        step = min(start, 65536)
        start = file.seek(start - step)
        tail = (file.read(step) or b"") + tail
    rest = tail[tail.rfind(b"\n") + 1 :]
    if rest:
        try:
            json.loads(rest)
        except ValueError:
            end -= len(rest)
            file.truncate(end)
            log.warning("%s: its last line was cut off (%d bytes) and has been removed", path, len(rest))
        else:
            file.seek(end)
            file.write(b"\n")
            end += 1
    return file.seek(end)
