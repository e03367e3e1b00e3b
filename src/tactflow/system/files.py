"""Paths and files."""

from __future__ import annotations

import errno
import glob
import io
import os
import platform
import re
import shutil
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TextIO

if sys.platform != "win32":
    import fcntl


def expanded(text: str) -> Path:
    """A path with `~` and `~name` expanded; an unknown name is left unchanged."""
    return Path(os.path.expanduser(text))


def is_utf8(text: str) -> bool:
    """Whether a text, such as a file name, can be encoded in UTF-8."""
    return text.encode(errors="replace").decode() == text


def status(text: str) -> os.stat_result | None:
    """The status of a path; None if it does not exist."""
    try:
        return expanded(text).stat()
    except (OSError, ValueError):
        return None


STREAMS = ("-", "/dev/stdout", "/dev/stderr")
"""Names of this process's streams, even if they are redirected to a regular file."""


def is_device(text: str) -> bool:
    """Whether it exists and is neither a regular file nor a folder: a terminal, a pipe, /dev/null."""
    file = status(text)
    return file is not None and not stat.S_ISREG(file.st_mode) and not stat.S_ISDIR(file.st_mode)


MAX_TEXT_FILE_BYTES = 1 << 20
"""Size limit of files of code or YAML, far above usual sizes."""


def read_limited(path: Path) -> bytes:
    """Read a file of code or YAML. Raises OSError if it is larger than `MAX_TEXT_FILE_BYTES`."""
    with path.open("rb") as stream:
        # A device such as /dev/zero has no end.
        data = stream.read(MAX_TEXT_FILE_BYTES + 1)
    if len(data) > MAX_TEXT_FILE_BYTES:
        raise OSError(errno.EFBIG, f"larger than {MAX_TEXT_FILE_BYTES >> 10} KiB")
    return data


def next_name(path: Path) -> Path:
    """The next numbered name after existing ones: press.mcap, press-001.mcap, press-002.mcap ...

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     Path(folder, "press-007.mcap").touch()
    ...     print(next_name(Path(folder, "press.mcap")).name)
    press-008.mcap
    """
    taken = 0
    pattern = re.compile(re.escape(path.stem) + r"-(\d+)" + re.escape(path.suffix))
    if path.parent.is_dir():
        for name in os.listdir(path.parent):
            match = pattern.fullmatch(name)
            taken = max(taken, int(match[1]) if match else 0)
    return path.with_name(f"{path.stem}-{taken + 1:03d}{path.suffix}")


@contextmanager
def completed(path: Path, *, make_parent: bool = True) -> Iterator[Path]:
    """A temporary path for a file or folder, renamed to `path` on success and removed on error.

    It replaces an existing file or folder, but a file never replaces a folder; if nothing was written,
    nothing is replaced. Its name begins with a dot, has the suffix of `path`, and holds host and process,
    since several processes may write the same file; what a killed process of this host left is removed.

    make_parent : whether to create missing parent folders.
    Raises OSError.
    """
    if make_parent:
        path.parent.mkdir(parents=True, exist_ok=True)
    front, end = f".{path.stem}.{platform.node()[:16]}-", f".partial{path.suffix}"
    for left in path.parent.glob(f"{glob.escape(front)}*{glob.escape(end)}"):
        process = left.name[len(front) : -len(end)]
        if process.isdecimal() and _has_ended(int(process)):
            _remove(left)
    partial = path.with_name(f"{front}{os.getpid()}{end}")
    try:
        yield partial
        if path.is_dir() and partial.is_dir():
            shutil.rmtree(path)
        if partial.exists():
            os.replace(partial, path)
    finally:
        _remove(partial)


def _has_ended(process: int) -> bool:
    if sys.platform == "win32":
        # Signal 0 would terminate the process.
        return False
    else:  # noqa: RET505 (mypy knows branches)
        try:
            os.kill(process, 0)
        except (ProcessLookupError, OverflowError):
            return True
        except PermissionError:
            pass
        return False


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, unless it exists. OSError names a file in its place."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        file = next((path for path in (folder, *folder.parents) if path.is_file()), folder)
        raise NotADirectoryError(errno.ENOTDIR, f"{file} is a file, not a folder") from None


def lock(descriptor: int) -> bool:
    """Lock an open file or folder until it is closed; False if another process has locked it.

    The lock is advisory and ends with the process. It always succeeds on file systems without locks, and does
    nothing on Windows, which does not allow replacing an open file.
    """
    if sys.platform != "win32":
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass
    return True


def lock_folder(folder: Path) -> int | None:
    """Lock a folder until the returned descriptor is closed; None on Windows, which cannot open a folder.

    Raises
    ------
    OSError : another process has locked it (BlockingIOError), or it cannot be opened.
    """
    if sys.platform == "win32":
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    if not lock(descriptor):
        os.close(descriptor)
        raise BlockingIOError(errno.EWOULDBLOCK, "another run is writing to it")
    return descriptor


class LossyStream(io.TextIOWrapper):
    """Standard error that discards its output after its reader has closed it, instead of raising.

    Parameters
    ----------
    stream : the standard error that it replaces.
    """

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream.buffer, stream.encoding, stream.errors, line_buffering=True)
        # Without a reference, the replaced stream would be collected and close the shared file.
        self._replaced = stream

    def write(self, text: str) -> int:
        """Write, or discard."""
        with suppress(OSError):
            return super().write(text)
        discard_output(self)
        return len(text)

    def flush(self) -> None:
        """Flush, or discard."""
        try:
            super().flush()
        except OSError:
            discard_output(self)


def discard_output(stream: IO[str]) -> None:
    """Redirect a stream to the null device, so that buffered and further output is discarded.

    This also covers the flush of standard output at exit.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
