"""Writing complete lines to a file or to the reader of a pipe."""

from __future__ import annotations

import errno
import json
import logging
import os
import select
import sys
import time
from collections import deque
from collections.abc import Mapping
from io import BufferedRandom
from pathlib import Path

from pydantic import Field

from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.message.result import Result
from tactflow.outputs import AppendParams, OutputSink, cannot_write, open_output, refuse_interference
from tactflow.system.files import discard_output, expanded, is_device

log = logging.getLogger("tactflow")

POLL_SECONDS = 0.1
"""Poll interval while waiting for a reader, s."""
LINGER_SECONDS = 1.0
"""Time to deliver the last lines when the run no longer waits for the reader, s; as for the ZeroMQ sink."""
MAX_QUEUED_LINES = 1000
"""Length of the queue for a slow reader, lines: 17 s at 60 Hz, 6 MB with 60 markers each."""
ATOMIC_BYTES = getattr(select, "PIPE_BUF", 512)
"""Bytes that a pipe takes without blocking when it is ready."""
MAX_LINE_BYTES = 1 << 24
"""Upper bound of a line, bytes: one with a displacement field has some 100 kB."""


class LineStream:
    """Writes complete lines to a pipe or standard output, at the pace of the reader.

    In a live run, the oldest of more than `MAX_QUEUED_LINES` lines are dropped; otherwise it waits for the
    reader.

    Parameters
    ----------
    path : a named pipe or device, whose reader the constructor waits for; "-" is standard output.
    control : the run, which is live or not, and may be stopped; or None.
    header : the first line of a table.

    Attributes
    ----------
    delivered, dropped : number of lines.
    ended : whether the reader has left or never came; an error only for a pipe that it has left.

    Raises
    ------
    StageError : from every method, if the pipe cannot be opened or written.
    """

    def __init__(self, path: str, control: Control | None = None, header: bytes | None = None) -> None:
        self.delivered = self.dropped = 0
        self.ended = False
        self._name = "standard output" if path == "-" else path
        self._control = control
        self._lines = deque([] if header is None else [header + b"\n"])
        self._begun = 0
        self._descriptor = sys.stdout.fileno() if path == "-" else self._open(expanded(path))

    def _open(self, path: Path) -> int:
        """Wait for the reader of a pipe, and open it; -1 if the run is stopped before."""
        waits = False
        while not self.ended:
            try:
                # Without O_NONBLOCK, this would block until a reader comes.
                return os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
            except OSError as error:
                # For a named pipe, it means that there is no reader yet.
                if error.errno != errno.ENXIO or not path.is_fifo():
                    raise cannot_write(path, error) from error
            if not waits:
                log.info("%s: waits for a reader", path)
            waits = True
            time.sleep(POLL_SECONDS)
            self.ended = self._is_hurried()
        return -1

    def _is_live(self) -> bool:
        source = None if self._control is None else self._control.source
        return source is not None and source.live

    def _is_hurried(self) -> bool:
        return self._control is not None and self._control.hurried

    def send(self, line: bytes) -> None:
        """Add a line without its line end; for a recording, wait while the queue is full."""
        self._lines.append(line + b"\n")
        self._write(0)
        while len(self._lines) > MAX_QUEUED_LINES and not self.ended:
            if self._is_live() or self._is_hurried():
                # The first line may be written in part.
                del self._lines[1]
                if not self.dropped:
                    log.warning("%s: its reader is too slow: lines are dropped", self._name)
                self.dropped += 1
            else:
                self._write(POLL_SECONDS)

    def _write(self, seconds: float) -> None:
        """Write lines while the reader takes them; wait up to `seconds` for it."""
        try:
            while self._lines and not self.ended and self._is_ready(seconds):
                line = self._lines[0]
                self._begun += os.write(self._descriptor, line[self._begun : self._begun + ATOMIC_BYTES])
                if self._begun == len(line):
                    self._lines.popleft()
                    self._begun = 0
                    self.delivered += 1
        except BlockingIOError:
            # Another process that writes to the same pipe has filled it since.
            return
        except OSError as error:
            self.ended = True
            if self._name == "standard output" and isinstance(error, BrokenPipeError | ConnectionResetError):
                discard_output(sys.stdout)
                return
            kept = f"the {self.delivered} lines written before are complete" if self.delivered else ""
            raise cannot_write(self._name, error, kept) from error

    def _is_ready(self, seconds: float) -> bool:
        # Windows can only wait for sockets: there, the write itself waits for the reader.
        return sys.platform == "win32" or bool(select.select([], [self._descriptor], [], seconds)[1])

    def close(self) -> None:
        """Write the rest and close the file, within `LINGER_SECONDS` if the run does not wait for the reader.

        Raises StageError also if the reader did not take all lines of a recording.
        """
        until = time.monotonic() + LINGER_SECONDS
        while self._lines and not self.ended:
            self._write(POLL_SECONDS)
            if (self._is_live() or self._is_hurried()) and time.monotonic() > until:
                break
        if self._descriptor >= 0 and self._name != "standard output":
            os.close(self._descriptor)
        if not self.ended:
            self.dropped += len(self._lines)
        if self.dropped and not self._is_live():
            raise StageError(
                f"{self._name}: its reader took only {self.delivered} lines before the run was stopped; "
                f"{self.dropped} more are lost"
            )


class LineFile:
    """Writes complete lines to a regular file, and detects interference by other programs.

    Parameters
    ----------
    path : the file.
    replaces, continues : whether it may exist; lines are appended after its last complete line.
    every : longest time that lines are buffered, s.
    header : first line of a table, without its line end; None for a file of result messages.

    Attributes
    ----------
    delivered : number of lines, without the header.

    Raises
    ------
    StageError : from every method, as `open_output`; if it cannot be written (it then ends with the last
        complete line); if another program has removed or replaced it; if it cannot be continued, because
        it does not end with a result message, or does not begin with the header.
    """

    ended = False

    def __init__(
        self,
        path: Path,
        *,
        replaces: bool = False,
        continues: bool = False,
        every: float,
        header: bytes | None = None,
    ) -> None:
        self.delivered = 0
        self._path = path
        self._every = every
        self._begun = False
        self._written = time.monotonic()
        advice = "append: true to continue it, "
        self._file = open_output(path, overwrite=replaces, append=continues, advice=advice)
        try:
            self._size, self._first = _continuation(self._file, path, header, replaces=replaces)
        except BaseException:
            self._file.close()
            raise
        self._waiting: list[bytes] = []
        self._uncounted = self._first.count(b"\n")

    def begin(self) -> None:
        """Remove what is replaced, or a last line that was cut off. Called once, or by the first `send`."""
        if not self._begun:
            self._begun = True
            self._file.truncate(self._size)
            if self._first:
                self._waiting = [self._first]

    def send(self, line: bytes) -> None:
        """Add a line without its line end."""
        self.begin()
        self._waiting.append(line + b"\n")
        now = time.monotonic()
        if now - self._written >= self._every:
            self._written = now
            self._write()

    def close(self) -> None:
        """Write buffered lines, and close the file. Without `begin`, it stays as it was."""
        try:
            if self._begun:
                self._write()
        finally:
            self._file.raw.close()

    def _write(self) -> None:
        data, self._waiting = b"".join(self._waiting), []
        written = 0
        try:
            # A raw file may write only a part; the next attempt raises the error.
            while written < len(data):
                written += self._file.raw.write(data[written:]) or 0
        except OSError as error:
            kept = data.rfind(b"\n", 0, written) + 1
            self._file.raw.truncate(self._file.raw.seek(0, os.SEEK_END) - (written - kept))
            self._count(data[:kept])
            complete = f"the {self.delivered} lines written before are complete"
            raise cannot_write(self._path, error, complete) from error
        self._count(data)
        ours = os.fstat(self._file.fileno())
        refuse_interference(self._path, ours, f"{self.delivered} lines are not in it")
        lost = self._size + len(data) - ours.st_size
        if lost > 0:
            log.warning("%s: was cut by another program: %d written bytes are gone", self._path, lost)
        self._size = ours.st_size

    def _count(self, data: bytes) -> None:
        lines = data.count(b"\n")
        self.delivered += max(0, lines - self._uncounted)
        self._uncounted = max(0, self._uncounted - lines)


def _continuation(
    file: BufferedRandom, path: Path, header: bytes | None, *, replaces: bool
) -> tuple[int, bytes]:
    """How a file is continued: number of its bytes that are kept, and what to write behind them first.

    Raises StageError if it has other content than that of this run, which must not be removed.
    """
    first = b"" if header is None else header + b"\n"
    end = file.seek(0, os.SEEK_END)
    if replaces or not end:
        return 0, first
    file.seek(0)
    if not first.startswith(file.read(len(first))):
        raise StageError(
            f"{path}: cannot be continued: its columns are not those of this run; give another path"
        )
    file.seek(max(0, end - MAX_LINE_BYTES))
    rest = file.read().rpartition(b"\n")[2]
    if header is None and rest:
        try:
            json.loads(rest)
            return end, b"\n"
        except (ValueError, RecursionError):
            # A power cut may leave NULs. Other content belongs to another program, or to the user.
            if not rest.startswith(b"{") and rest.strip(b"\0"):
                raise StageError(
                    f"{path}: cannot be continued: it does not end with a result message; give another path"
                ) from None
    if rest:
        # A row of a table that was cut off may end with what looks like a number.
        log.warning("%s: its last line was cut off (%d bytes) and has been removed", path, len(rest))
    kept = end - len(rest)
    return kept, b"" if kept else first


class LineParams(AppendParams):
    """Parameters of a sink that writes lines."""

    flush: float = Field(0.5, ge=0, description="longest time that lines are buffered, s; 0: not at all")


class LineSink(OutputSink):
    """Base class of sinks that write one line for each frame to a file, a pipe or standard output.

    Lines reach a file at least every `flush` seconds and at the end, and standard output at once. If the
    reader of standard output closes it, the sink requests no more frames. A recording waits for a slow
    reader; in a live run, lines are dropped and counted instead.

    A subclass defines `line(result) -> bytes` and, for a table, `header`.
    """

    queue_capacity = 16
    header: bytes | None = None
    """The first line of a table."""

    def __init__(self, params: LineParams, control: Control | None = None) -> None:
        """Prepare; nothing is opened yet.

        control : the run, which may be live; None: a slow reader is waited for.
        """
        super().__init__(params)
        self._control = control
        self.description = "standard output" if params.path == "-" else params.path
        self._out: LineFile | LineStream | None = None
        self._closed = False

    def line(self, result: Result) -> bytes:
        """The line of a frame, without its line end."""
        raise NotImplementedError

    @classmethod
    def outputs(cls, params: LineParams) -> Mapping[str, Path]:
        """The file, or none for standard output."""
        return {} if params.path == "-" else super().outputs(params)

    def open(self) -> None:
        """Open or create the file and its folder, or wait for the reader of a pipe.

        Raises StageError if the file exists and neither `overwrite` nor `append` is set, another run is
        writing to it, or it cannot be written or continued.
        """
        p = self.params
        if p.path == "-" or is_device(p.path):
            self._out = LineStream(p.path, self._control, self.header)
        else:
            self._out = LineFile(
                expanded(p.path),
                replaces=p.overwrite,
                continues=p.append,
                every=p.flush,
                header=self.header,
            )

    def begin(self) -> None:
        """Empty the file, if it is replaced, and write the header of a table."""
        if isinstance(self._out, LineFile):
            self._out.begin()

    def wants(self) -> bool:
        """False once the reader of standard output has closed it."""
        return self._out is not None and not self._closed and not self._out.ended

    def counters(self) -> dict[str, int]:
        """lines : written so far. dropped : lines not read from a pipe in time."""
        lines = 0 if self._out is None else self._out.delivered
        dropped = {"dropped": self._out.dropped} if isinstance(self._out, LineStream) else {}
        return {"lines": lines} | dropped

    def write(self, result: Result) -> None:
        """Add one line.

        Raises StageError if the file cannot be written, for instance on a full disk. The file then ends with
        its last complete line.
        """
        if self._out is not None and self.wants():
            self._out.send(self.line(result))

    def close(self) -> None:
        """Write buffered lines and close the file.

        Raises StageError if that fails, or the reader of a pipe did not read all lines of a recording.
        """
        if self._out is not None and not self._closed:
            self._closed = True
            self._out.close()
