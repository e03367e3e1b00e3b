"""Files that a run writes: created, and checked to be still there."""

from __future__ import annotations

import os
from pathlib import Path

from tactflow.engine.errors import StageError
from tactflow.system.files import is_device, make_folder


def cannot_write(path: Path | str, error: OSError, kept: str = "") -> StageError:
    """The error to raise where a file cannot be written. kept : what is safe, and what to do."""
    return StageError(f"{path}: cannot be written: {error.strerror or error}{kept and f'; {kept}'}")


def refuse_existing(path: Path, *, overwrite: bool, others: str = "") -> None:
    """Refuse a file that is there, unless it may be replaced, and a pipe or device, which can hang.

    others : what else to try, such as `append: true to continue it, `.

    Raises
    ------
    StageError : there is one.
    """
    if path.exists() and not path.is_dir() and not overwrite:
        raise StageError(
            f"{path}: this file exists; set overwrite: true to replace it, {others}or give another path"
        )
    if is_device(str(path)):
        raise StageError(f"{path}: required a file, not a pipe or device; give another path")


def create(path: Path, *, overwrite: bool) -> None:
    """Create an empty file and its folder, or empty an existing file with `overwrite`.

    Raises
    ------
    StageError : it exists, or cannot be written.
    """
    refuse_existing(path, overwrite=overwrite)
    try:
        make_folder(path.parent)
        path.open("wb").close()
    except OSError as error:
        raise cannot_write(path, error) from error


def refuse_interference(path: Path, ours: os.stat_result, lost: str, length: int = 0) -> None:
    """Notice that another program has removed, replaced or cut a file that we write.

    ours : of the file that is open. lost : what becomes of our data, in words. length : that it must have,
    bytes.

    Raises
    ------
    StageError : one has.
    """
    try:
        there = path.stat()
    except OSError:
        what = "removed"
    else:
        what = "cut" if ours.st_size < length else "" if os.path.samestat(there, ours) else "replaced"
    if what:
        raise StageError(f"{path}: was {what} by another program while the run wrote to it; {lost}")
