"""Where compiled kernels are kept, and who compiles which.

numba keeps what it compiled in `NUMBA_CACHE_DIR` if that is set, else beside the source, else in the user's
cache folder. Where it may write to none of these, a folder of this user among the temporary files is taken.
Without any, kernels are compiled in each run.
"""

from __future__ import annotations

import getpass
import logging
import os
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any, Final
from zlib import crc32

logger = logging.getLogger("tactflow")

PATIENCE_S: Final = 60.0
"""Longest wait for another process that compiles a kernel; it may be stopped. The longest takes 4 s (see
docs/kernels.md)."""

POLL_S: Final = 0.02
"""Pause between two attempts to claim a kernel. Chosen by hand."""

LOCK = "tactflow-kernels.lock"
"""File in each cache folder; who compiles a kernel holds one byte of it. It is never deleted."""


def dispatcher_of(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """numba's dispatcher of a function, with a place on disk if there is one; nothing is compiled yet."""
    numba: Any = import_module("numba")
    try:
        return numba.njit(cache=True, **options)(function)
    except (RuntimeError, OSError):
        # numba has no place for it.
        folder = _temporary_folder() if Path(function.__code__.co_filename).exists() else None
    if folder is None:
        return numba.njit(**options)(function)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return numba.njit(cache=True, **options)(function)
    finally:
        numba.config.CACHE_DIR = before


@contextmanager
def claimed(folder: str | None, name: str, wait: bool) -> Iterator[bool]:
    """Whether this process may compile a kernel now; no other may within the block.

    The claim is a lock of the operating system, which ends with the process that holds it, however that ends.

    folder : of the cache; None: there is none, and nothing to agree upon.
    wait : until the process that has claimed it is done, rather than give up; after `PATIENCE_S` it is
        compiled without a claim.
    """
    try:
        lock = None if folder is None else open(Path(folder) / LOCK, "ab")  # noqa: SIM115 (closed below)
    except OSError:
        lock = None
    if lock is None:
        yield True
        return
    with lock:
        yield _lock(lock, crc32(name.encode()), wait)


if sys.platform == "win32":

    def _lock(_file: IO[bytes], _byte: int, _wait: bool) -> bool:
        """Nothing is locked on Windows: processes that start together compile the same."""
        return True

else:
    import fcntl

    def _lock(file: IO[bytes], byte: int, wait: bool) -> bool:
        """Lock one byte of a file until it is closed; whether this process may go on."""
        until = time.monotonic() + (PATIENCE_S if wait else 0.0)
        while True:
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
                return True
            except BlockingIOError:
                if time.monotonic() >= until:
                    return wait
            except OSError:
                # A file system without locks.
                return True
            time.sleep(POLL_S)


@cache
def _temporary_folder() -> Path | None:
    """A folder that only this user can write to, since what lies there is run; None if there is none."""
    try:
        folder = Path(tempfile.gettempdir()) / f"tactflow-kernels-{getpass.getuser()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        if _is_ours(folder):
            return folder
        reason = f"{folder} belongs to somebody else"
    except (OSError, KeyError) as error:
        # Before Python 3.13, a user without a name is a KeyError.
        reason = str(error)
    logger.warning(
        "compiled loops cannot be kept (%s): they are compiled in each run; set NUMBA_CACHE_DIR to a folder",
        reason,
    )
    return None


def _is_ours(folder: Path) -> bool:
    """Whether this is a folder, and nobody else can write to it."""
    if sys.platform == "win32":
        # The folder of temporary files is each user's own.
        return folder.is_dir()
    found = folder.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
