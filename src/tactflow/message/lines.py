"""Writing complete lines to a file or to the reader of a pipe."""

from __future__ import annotations

import json
import logging
import os
import queue
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.outputs import cannot_write, refuse_interference
from tactflow.system.files import claim_path, discard_output, expanded, make_folder

log = logging.getLogger("tactflow")

LOOK_EVERY = 0.1
"""Poll interval while waiting for a reader, s."""
LINGER = 1.0
"""Time to deliver the last lines when the run no longer waits for the reader, s; as for the ZeroMQ sink."""
MOST_WAITING = 1000
"""Length of the queue for a slow reader, lines: 17 s at 60 Hz, 6 MB with 60 markers each."""
LONGEST_LINE = 1 << 24
"""Upper bound of a line, bytes: one with a displacement field has some 100 kB."""


class LineStream:
    """Writes complete lines to a pipe or standard output, in its own thread, at the pace of the reader.

    In a live run, the oldest of more than `MOST_WAITING` lines are dropped; otherwise it waits for the
    reader.

    path : a named pipe or device, whose reader the constructor waits for; "-" is standard output.
    control : the run, which is live or not, and may be stopped; or None.
    delivered, dropped : number of lines. ended : whether there is no reader (any more), which is not an
    error.

    Raises
    ------
    StageError : from every method, if the pipe cannot be opened or written.
    """

    def __init__(self, path: str, control: Control | None = None) -> None:
        self.delivered = self.dropped = 0
        self.ended = False
        self._name = "standard output" if path == "-" else path
        self._control = control
        self._sent = 0
        self._lines: queue.Queue[bytes | None] = queue.Queue(MOST_WAITING)
        self._error: OSError | None = None
        self._opened = threading.Event()
        # A daemon, because opening or writing a pipe may block forever.
        self._thread = threading.Thread(target=self._deliver, args=(path,), daemon=True)
        self._thread.start()
        if not self._opened.wait(LOOK_EVERY):
            log.info("%s: waits for a reader", path)
        while not self._opened.wait(LOOK_EVERY) and not self.ended:
            self.ended = self._is_hurried()
        self._raise_error()

    def _deliver(self, path: str) -> None:
        """Body of the thread."""
        try:
            # Unbuffered: Python could not flush the buffer of standard output at exit while a write hangs.
            number = sys.stdout.fileno() if path == "-" else os.open(expanded(path), os.O_WRONLY)
            self._opened.set()
            with os.fdopen(number, "wb", buffering=0, closefd=path != "-") as file:
                while (line := self._lines.get()) is not None:
                    while line:
                        line = line[file.write(line) or 0 :]
                    self.delivered += 1
        except OSError as error:
            if path == "-" and isinstance(error, BrokenPipeError | ConnectionResetError):
                discard_output(sys.stdout)
            else:
                self._error = error
            self.ended = True
        finally:
            self._opened.set()

    def _raise_error(self) -> None:
        if self._error is not None:
            kept = f"the {self.delivered} lines written before are complete" if self.delivered else ""
            raise cannot_write(self._name, self._error, kept) from self._error

    def _is_live(self) -> bool:
        source = None if self._control is None else self._control.source
        return source is not None and source.live

    def _is_hurried(self) -> bool:
        return self._control is not None and self._control.hurried

    def send(self, line: bytes) -> None:
        """Add a line without its line end; for a recording, wait while the queue is full."""
        while not self.ended:
            waits = not (self._is_live() or self._is_hurried())
            try:
                self._lines.put(line + b"\n", waits, LOOK_EVERY)
            except queue.Full:
                if not waits:
                    self._drop_oldest()
                continue
            self._sent += 1
            return
        self._raise_error()

    def _drop_oldest(self) -> None:
        with suppress(queue.Empty):
            self._lines.get_nowait()
            if not self.dropped:
                log.warning("%s: its reader is too slow: lines are dropped", self._name)
            self.dropped += 1

    def close(self) -> None:
        """Write the rest, for at most `LINGER` if the run does not wait for the reader, and close the file.

        Raises StageError also if the reader did not take all lines of a recording.
        """
        until = time.monotonic() + LINGER
        while self._thread.is_alive() and not self.ended:
            with suppress(queue.Full):
                self._lines.put(None, timeout=LOOK_EVERY)
            self._thread.join(LOOK_EVERY)
            if (self._is_live() or self._is_hurried()) and time.monotonic() > until:
                break
        self._raise_error()
        if not self.ended:
            self.dropped = self._sent - self.delivered
        if self.dropped and not self._is_live():
            raise StageError(
                f"{self._name}: its reader took only {self.delivered} lines before the run was stopped; "
                f"{self.dropped} more are lost"
            )


class LineFile:
    """Writes complete lines to a regular file, and detects interference by other programs.

    path : the file; created with its folder. replaces : whether to truncate it; otherwise lines are appended
    after its last complete line. every : longest time that lines are buffered, s. delivered : number of
    lines.

    Raises
    ------
    StageError : from every method, if it cannot be written (it then ends with the last complete line), if
        another program has removed or replaced it, another run is writing to it, or if it does not end with
        a result message.
    """

    ended = False

    def __init__(self, path: Path, *, replaces: bool = False, every: float = 0.0) -> None:
        self.delivered = 0
        self._path = path
        self._every = every
        self._waiting: list[bytes] = []
        self._written = time.monotonic()
        try:
            make_folder(path.parent)
            # In append mode, no gap of NULs follows if another program truncates the file.
            self._file = path.open("ab+", buffering=0)
        except OSError as error:
            raise cannot_write(path, error) from error
        self._claim: int | None = None
        try:
            self._claim = claim_path(path)
            if replaces:
                self._file.truncate(0)
            self._size = _complete_last_line(self._file, path)
        except BlockingIOError as error:
            self._release()
            raise cannot_write(
                path, error, "give another path (--set sinks.jsonl.path=other.jsonl)"
            ) from error
        except BaseException:
            self._release()
            raise

    def send(self, line: bytes) -> None:
        """Add a line without its line end."""
        self._waiting.append(line + b"\n")
        now = time.monotonic()
        if now - self._written >= self._every:
            self._written = now
            self._write()

    def close(self) -> None:
        """Write buffered lines, and close the file."""
        try:
            self._write()
        finally:
            self._release()

    def _release(self) -> None:
        """Close the file, and let other runs have it."""
        with suppress(OSError):
            self._file.close()
        if self._claim is not None:
            os.close(self._claim)
            self._claim = None

    def _write(self) -> None:
        data, self._waiting = b"".join(self._waiting), []
        written = 0
        try:
            # A raw file may write only a part; the next attempt raises the error.
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            kept = data.rfind(b"\n", 0, written) + 1
            self._file.truncate(self._file.seek(0, os.SEEK_END) - (written - kept))
            self.delivered += data.count(b"\n", 0, kept)
            complete = f"the {self.delivered} lines written before are complete"
            raise cannot_write(self._path, error, complete) from error
        self.delivered += data.count(b"\n")
        ours = os.fstat(self._file.fileno())
        refuse_interference(self._path, ours, f"{self.delivered} lines are not in it")
        lost = self._size + len(data) - ours.st_size
        if lost > 0:
            log.warning("%s: was cut by another program: %d written bytes are gone", self._path, lost)
        self._size = ours.st_size


def _complete_last_line(file: BinaryIO, path: Path) -> int:
    """Terminate the last line of a file, or remove an incomplete message; returns the size of the file,
    bytes.

    Raises StageError if the file ends with other content, which must not be removed.
    """
    end = file.seek(0, os.SEEK_END)
    file.seek(max(0, end - LONGEST_LINE))
    rest = file.read().rpartition(b"\n")[2]
    if not rest:
        return end
    try:
        json.loads(rest)
        file.write(b"\n")
    except (ValueError, RecursionError):
        # A power cut may leave NULs. Other content belongs to another program, or to the user.
        if not rest.startswith(b"{") and rest.strip(b"\0"):
            raise StageError(
                f"{path}: cannot be continued: it does not end with a result message; give another path"
            ) from None
        file.truncate(end - len(rest))
        log.warning("%s: its last line was cut off (%d bytes) and has been removed", path, len(rest))
    return file.seek(0, os.SEEK_END)
