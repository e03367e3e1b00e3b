"""Whole lines: to a file that others may cut or remove, or to a reader who may be slow or never come."""

from __future__ import annotations

import errno
import json
import logging
import os
import select
import sys
import time
from collections import deque
from contextlib import suppress
from io import BytesIO, UnsupportedOperation
from itertools import count
from pathlib import Path
from typing import BinaryIO

from tactflow.engine.control import Control
from tactflow.engine.errors import StageError
from tactflow.system.files import discard_output, expanded, make_folder
from tactflow.system.outputs import cannot_write, refuse_interference

log = logging.getLogger("tactflow")

LOOK_EVERY = 0.1
"""Time between two looks whether to go on waiting for a reader, s. Chosen by hand."""
LINGER = 1.0
"""Time to deliver the last lines to a reader who is not waited for any more, s; as the ZeroMQ sink's."""
MOST_WAITING = 1000
"""Lines kept for a reader that takes none: 17 s at 60 Hz, 6 MB with 60 markers each. Chosen by hand."""


if sys.platform == "win32":
    _CHUNK = 512

    def _open_pipe(path: Path) -> int:
        return os.open(path, os.O_WRONLY)

    def _writable(_number: int, _seconds: float) -> bool:
        return True

else:
    _CHUNK = select.PIPE_BUF

    def _open_pipe(path: Path) -> int:
        """Open a pipe for writing; raises ENXIO instead of waiting while it has no reader."""
        number = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        os.set_blocking(number, True)
        return number

    def _writable(number: int, seconds: float) -> bool:
        poll = select.poll()
        poll.register(number, select.POLLOUT)
        return bool(poll.poll(round(seconds * 1000)))


class LineStream:
    """Writes whole lines to a pipe or standard output, or keeps them for a slow reader.

    In a live run, the oldest beyond `MOST_WAITING` lines are dropped; otherwise the reader is waited for.

    path : the named pipe or device, for whose reader the constructor waits; "-" is standard output.
    control : the run, which knows whether it is live, and whether it is to end; or None.
    delivered, dropped : lines. ended : there is no reader (any more), which is no error.

    Raises
    ------
    StageError : from every method, if the pipe cannot be opened or written.
    """

    def __init__(self, path: str, control: Control | None = None) -> None:
        self.delivered = self.dropped = 0
        self.ended = False
        self._control = control
        self._name = "standard output" if path == "-" else path
        self._lines: deque[bytes] = deque()
        self._sent = 0
        self._file: BinaryIO = sys.stdout.buffer if path == "-" else self._open(expanded(path))

    def _open(self, path: Path) -> BinaryIO:
        for attempt in count():
            try:
                return os.fdopen(_open_pipe(path), "wb", buffering=0)
            except OSError as error:
                if error.errno != errno.ENXIO or not path.is_fifo():
                    raise cannot_write(path, error) from error
            if attempt == 0:
                log.info("%s: waits for a reader", path)
            if self._hurried():
                break
            time.sleep(LOOK_EVERY)
        self.ended = True
        return BytesIO()

    def _live(self) -> bool:
        source = None if self._control is None else self._control.source
        return source is not None and source.live

    def _hurried(self) -> bool:
        return self._control is not None and self._control.hurried

    def send(self, line: bytes) -> None:
        """Add a line, without its end, and write what the reader takes."""
        self._lines.append(line + b"\n")
        self._write(0.0)
        while len(self._lines) > MOST_WAITING:
            # The rest of a line that was begun has to follow.
            del self._lines[1 if self._sent else 0]
            if not self.dropped:
                log.warning("%s: its reader is too slow: lines are dropped", self._name)
            self.dropped += 1

    def close(self) -> None:
        """Write the rest, for `LINGER` if nobody waits for the reader, and close the file.

        Also raises StageError if the reader did not take all lines of a recording.
        """
        try:
            if not self.ended:
                self._write(LINGER)
                self.dropped += len(self._lines)
            if self.dropped and not self._live():
                raise StageError(
                    f"{self._name}: its reader took only {self.delivered} lines before the run was stopped; "
                    f"{self.dropped} more are lost"
                )
        finally:
            if self._file is not sys.stdout.buffer:
                with suppress(OSError):
                    self._file.close()

    def _write(self, patience: float) -> None:
        """Write what the reader takes; where nobody waits for it, for `patience` s at most."""
        until = time.monotonic() + patience
        try:
            while self._lines:
                if not self._takes_more(0.0):
                    if (self._live() or self._hurried()) and time.monotonic() >= until:
                        return
                    self._takes_more(LOOK_EVERY)
                    continue
                line = self._lines[0]
                self._sent += self._file.write(line[self._sent : self._sent + _CHUNK])
                self._file.flush()
                if self._sent >= len(line):
                    self._lines.popleft()
                    self._sent = 0
                    self.delivered += 1
        except OSError as error:
            if self._file is sys.stdout.buffer and error.errno in (errno.EPIPE, errno.ECONNRESET):
                self.ended = True
                discard_output(sys.stdout)
                return
            kept = f"the {self.delivered} lines written before are complete"
            raise cannot_write(self._name, error, kept) from error

    def _takes_more(self, seconds: float) -> bool:
        """Whether a write of up to `_CHUNK` bytes returns at once, perhaps with an error."""
        try:
            number = self._file.fileno()
        except (UnsupportedOperation, ValueError):
            # A program has replaced standard output by something of its own.
            return True
        return _writable(number, seconds)


class LineFile:
    """Writes whole lines to a regular file, and notices what other programs do to it.

    path : the file; created with its folder. replaces : empty it first. Otherwise lines are added after its
    last complete line. every : longest time that lines wait before they are written, s. delivered : lines.

    Raises
    ------
    StageError : from every method, if it cannot be written; it then ends with the last line that fitted. Or
        another program has removed or replaced it, or it does not end with a result message.
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
            # Appending: where another program cuts the file, no gap of NULs follows.
            self._file = path.open("ab+", buffering=0)
        except OSError as error:
            raise cannot_write(path, error) from error
        try:
            if replaces:
                self._file.truncate(0)
            self._size = _complete_last_line(self._file, path)
        except BaseException:
            self._file.close()
            raise

    def send(self, line: bytes) -> None:
        """Add a line, without its end."""
        self._waiting.append(line + b"\n")
        now = time.monotonic()
        if now - self._written >= self._every:
            self._written = now
            self._write()

    def close(self) -> None:
        """Write what is left and close the file."""
        try:
            self._write()
        finally:
            with suppress(OSError):
                self._file.close()

    def _write(self) -> None:
        data, self._waiting = b"".join(self._waiting), []
        written = 0
        try:
            # An unbuffered file may take only a part, and says why at the next attempt.
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
        gone = self._size + len(data) - ours.st_size
        if gone > 0:
            log.warning("%s: was cut by another program: %d written bytes are gone", self._path, gone)
        self._size = ours.st_size


def _complete_last_line(file: BinaryIO, path: Path) -> int:
    """End the last line of a file, or cut off half a message; returns the size of the file, bytes.

    Raises StageError if the file ends with something else: that is not ours to cut off.
    """
    end = start = file.seek(0, os.SEEK_END)
    tail = b""
    while start > 0 and b"\n" not in tail:
        step = min(start, 65536)
        start = file.seek(start - step)
        tail = file.read(step) + tail
    rest = tail[tail.rfind(b"\n") + 1 :]
    if not rest:
        return end
    try:
        json.loads(rest)
        file.write(b"\n")
    except (ValueError, RecursionError):
        # A power cut may leave NULs. Anything else belongs to another program, or to the user.
        if not rest.startswith(b"{") and rest.strip(b"\0"):
            raise StageError(
                f"{path}: cannot be continued: it does not end with a result message; give another path"
            ) from None
        file.truncate(end - len(rest))
        log.warning("%s: its last line was cut off (%d bytes) and has been removed", path, len(rest))
    return file.seek(0, os.SEEK_END)
