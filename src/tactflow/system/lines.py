"""Whole lines, in a file that others may cut or take away, or for a reader who may be slow or never come."""

from __future__ import annotations

import errno
import json
import logging
import os
import select
import stat
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from io import UnsupportedOperation
from pathlib import Path
from typing import BinaryIO

from tactflow.engine.errors import StageError
from tactflow.system.files import claim, taken_away

log = logging.getLogger("tactflow")

LOOK_EVERY = 0.1
"""Time between two looks whether to go on waiting for a reader, s. Chosen by hand."""
LINGER = 1.0
"""Time to deliver the last lines to a reader who is not waited for any more, s; as the ZeroMQ sink's."""
MOST_WAITING = 1000
"""Lines kept for a reader that takes none: 17 s at 60 Hz, 6 MB with 60 markers each. Chosen by hand."""
if sys.platform == "win32":
    PIPE_BUF = 512

    def takes_more(_file: BinaryIO, _seconds: float) -> bool:
        """True: here nobody can tell."""
        return True

    def open_pipe(path: Path, _goes_on: Callable[[], bool]) -> BinaryIO | None:
        """Open a device for writing. Raises OSError if that cannot be."""
        return path.open("wb", buffering=0)

else:
    PIPE_BUF = select.PIPE_BUF
    """Bytes that a pipe takes without waiting where it takes any."""

    def takes_more(file: BinaryIO, seconds: float) -> bool:
        """Whether up to `PIPE_BUF` bytes can be written without waiting; waits for that for so long.

        Also True where writing fails at once, because the reader has left.
        """
        try:
            number = file.fileno()
        except (UnsupportedOperation, ValueError):
            # A program has put something of its own in the place of standard output.
            return True
        poll = select.poll()
        poll.register(number, select.POLLOUT)
        return bool(poll.poll(round(seconds * 1000)))

    def open_pipe(path: Path, goes_on: Callable[[], bool]) -> BinaryIO | None:
        """Open a named pipe or device for writing; None if nobody came to read before the run was to end.

        goes_on : whether to go on waiting for a reader.

        Raises
        ------
        OSError : it cannot be opened.
        """
        told = False
        while True:
            try:
                number = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError as error:
                if error.errno != errno.ENXIO or not stat.S_ISFIFO(path.stat().st_mode):
                    raise
            else:
                os.set_blocking(number, True)
                return os.fdopen(number, "wb", buffering=0)
            if not told:
                told = True
                log.info("%s: waits for a reader", path)
            if not goes_on():
                return None
            time.sleep(LOOK_EVERY)


class LineStream:
    """Writes whole lines to a pipe, or keeps them for a reader that does not take them.

    file : where to. waits : whether to wait for the reader just now; else, beyond `MOST_WAITING` lines, the
    oldest are dropped.

    Attributes
    ----------
    delivered, dropped : lines.

    Examples
    --------
    >>> from io import BytesIO
    >>> file = BytesIO()
    >>> stream = LineStream(file, lambda: True)
    >>> stream.send([b"one", b"two"])
    >>> file.getvalue().split(), stream.delivered
    ([b'one', b'two'], 2)
    """

    def __init__(self, file: BinaryIO, waits: Callable[[], bool]) -> None:
        self.delivered = 0
        self.dropped = 0
        self._file = file
        self._waits = waits
        self._lines: deque[bytes] = deque()
        self._sent = 0

    def send(self, lines: Iterable[bytes]) -> None:
        """Add lines, without their ends, and write what the reader takes. Raises OSError if that fails."""
        self._lines.extend(line + b"\n" for line in lines)
        self._write(0.0)
        while len(self._lines) > MOST_WAITING:
            # The rest of a line that was begun has to follow.
            del self._lines[1 if self._sent else 0]
            self.dropped += 1

    def finish(self) -> None:
        """Write the rest, for `LINGER` if nobody waits for the reader; what is left then is dropped.

        Raises
        ------
        OSError : it cannot be written.
        """
        self._write(LINGER)
        self.dropped += len(self._lines)
        self._lines.clear()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _write(self, patience: float) -> None:
        until = time.monotonic() + patience
        while self._lines:
            if not takes_more(self._file, 0.0):
                if not self._waits() and time.monotonic() >= until:
                    return
                takes_more(self._file, LOOK_EVERY)
                continue
            line = self._lines[0]
            self._sent += self._file.write(line[self._sent : self._sent + PIPE_BUF])
            self._file.flush()
            if self._sent >= len(line):
                self._lines.popleft()
                self._sent = 0
                self.delivered += 1


class LineFile:
    """Writes whole lines to a regular file, and notices what other programs do to it.

    path : the file; created unless it is there. replaces : empty it first. continues : begin after its last
    complete line.

    Raises
    ------
    OSError : it cannot be opened, or another run writes to it.
    StageError : what it is to continue holds something else.

    Attributes
    ----------
    delivered : lines.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "numbers.txt")
    ...     file = LineFile(path, replaces=False, continues=False)
    ...     file.send([b"one", b"two"])
    ...     file.close()
    ...     path.read_text().split()
    ['one', 'two']
    """

    dropped = 0

    def __init__(self, path: Path, *, replaces: bool, continues: bool) -> None:
        self.delivered = 0
        self._path = path
        create = os.O_CREAT if path.exists() else os.O_CREAT | os.O_EXCL
        # At the end whatever happens: where another program has cut the file, no gap of NULs may follow.
        flags = os.O_RDWR | os.O_APPEND | getattr(os, "O_BINARY", 0) | create
        self._file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
        claim(self._file)
        if replaces:
            self._file.truncate(0)
        try:
            self._complete = _continue_at(self._file, path) if continues else 0
        except BaseException:
            self._file.close()
            raise

    def send(self, lines: Sequence[bytes]) -> None:
        """Write lines, without their ends.

        Raises
        ------
        OSError : not all could be written; the file then ends with the last line that fitted. StageError :
        another program has taken the file away.
        """
        data = memoryview(b"\n".join([*lines, b""]))
        written = 0
        try:
            # An unbuffered file may take only a part, and says why at the next attempt.
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError:
            self._cut_at_complete_line(data[:written])
            raise
        self.delivered += len(lines)
        self._check(len(data))

    def finish(self) -> None:
        """See whether the lines are still there. Raises StageError as `send` does."""
        self._check(0)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _check(self, written: int) -> None:
        """Find out that others have removed, replaced or cut the file.

        written : bytes since the last look.
        """
        path, ours = self._path, os.fstat(self._file.fileno())
        what = taken_away(path, ours)
        expected, self._complete = self._complete + written, ours.st_size
        if what is not None:
            raise StageError(
                f"{path}: was {what} by another program while the run wrote to it; {self.delivered} lines "
                "are not in it"
            )
        if ours.st_size < expected:
            gone = expected - ours.st_size
            log.warning("%s: was cut by another program: %d bytes that were written are gone", path, gone)

    def _cut_at_complete_line(self, written: memoryview) -> None:
        """After a failed write, leave the file with complete lines only."""
        kept = bytes(written).rfind(b"\n") + 1
        self.delivered += bytes(written).count(b"\n")
        self._complete = os.fstat(self._file.fileno()).st_size - len(written) + kept
        self._file.truncate(self._complete)


def _continue_at(file: BinaryIO, path: Path) -> int:
    """Seek to the end of the last complete line, completing or cutting off what follows it; its offset.

    Raises StageError if what follows is no beginning of a message: it is not ours to cut off.
    """
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
            # A power cut may leave NULs. Anything else is of another program, or of the user.
            if not rest.startswith(b"{") and rest.strip(b"\0"):
                raise StageError(
                    f"{path}: cannot be continued: it does not end with a result message; give another path"
                ) from None
            end -= len(rest)
            file.truncate(end)
            log.warning("%s: its last line was cut off (%d bytes) and has been removed", path, len(rest))
        else:
            file.seek(end)
            file.write(b"\n")
            end += 1
    return file.seek(end)
