"""Files as pipelines and command lines name them."""

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
    """A path with `~` and `~name` replaced. An unknown name stays, and is reported as a missing file."""
    return Path(os.path.expanduser(text))


def is_utf8(text: str) -> bool:
    """Whether a text, such as the name of a file, can be written to messages and tables.

    >>> is_utf8("left-ü"), is_utf8("left-\\udcff")
    (True, False)
    """
    return text.encode(errors="replace").decode() == text


def status(text: str) -> os.stat_result | None:
    """The status of a path; None if nothing is there."""
    try:
        return expanded(text).stat()
    except (OSError, ValueError):
        return None


def is_device(text: str) -> bool:
    """Whether it exists and is neither a regular file nor a folder: a terminal, a pipe, /dev/null."""
    found = status(text)
    return found is not None and not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode)


MAX_BYTES = 1 << 20
"""Size limit of a file of code or YAML: far above any that people write."""


def read_limited(path: Path) -> bytes:
    """The bytes of a file of code or YAML. Raises OSError for one that is larger than `MAX_BYTES`."""
    with path.open("rb") as stream:
        # A device such as /dev/zero has no end.
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise OSError(errno.EFBIG, f"larger than {MAX_BYTES >> 10} KiB")
    return data


def next_name(path: Path) -> Path:
    """The numbered name after those that are taken: press.mcap, press-001.mcap, press-002.mcap ...

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
            found = pattern.fullmatch(name)
            taken = max(taken, int(found[1]) if found else 0)
    return path.with_name(f"{path.stem}-{taken + 1:03d}{path.suffix}")


@contextmanager
def completed(path: Path, *, make_parent: bool = True) -> Iterator[Path]:
    """A path to write a file or a folder to, renamed to `path` if all went well and removed if not.

    It replaces what is there, but no file replaces a folder; if nothing was written, nothing is replaced. Its
    name begins with a dot and ends as that of `path` does. What a killed process of this machine has left for
    the same path is removed first.

    make_parent : whether folders above are made; if not, they have to be there.
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
        # Signal 0 would end it there.
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
    """Make a folder and all above it, unless it exists.

    Raises
    ------
    OSError : it cannot be made; where a file is in its place, `strerror` says which.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        file = next((path for path in (folder, *folder.parents) if path.is_file()), folder)
        raise NotADirectoryError(errno.ENOTDIR, f"{file} is a file, not a folder") from None


def claim_path(path: Path) -> int | None:
    """Claim a file or a folder that exists until the descriptor returned is closed.

    The claim binds only those who ask. It ends with the process, however that ends; where the file system
    knows no locks, everybody gets one. Windows itself refuses to replace a file that is open.

    Raises
    ------
    OSError : another run has claimed it (BlockingIOError), or it cannot be opened.
    """
    if sys.platform == "win32":
        return None
    else:  # noqa: RET505 (mypy knows branches)
        descriptor = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise BlockingIOError(errno.EWOULDBLOCK, "another run is writing to it") from None
        except OSError:
            pass
        return descriptor


class LossyStream(io.TextIOWrapper):
    """Standard error that loses its output, instead of raising, once its reader has left.

    stream : the present standard error, which it replaces.
    """

    def __init__(self, stream: TextIO) -> None:
        super().__init__(stream.buffer, stream.encoding, stream.errors, line_buffering=True)
        # Without a reference, it would close what both write to.
        self._replaced = stream

    def write(self, text: str) -> int:
        """Write, or lose it."""
        with suppress(OSError):
            return super().write(text)
        discard_output(self)
        return len(text)

    def flush(self) -> None:
        """Flush, or lose it."""
        try:
            super().flush()
        except OSError:
            discard_output(self)


def discard_output(stream: IO[str]) -> None:
    """Lead a stream to the null device: what it has buffered and what follows is lost without an error.

    Python flushes standard output once more at exit.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
