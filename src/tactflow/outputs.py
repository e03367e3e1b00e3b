"""Output files of a run: their parameters, opening and locking them, and detecting interference."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedRandom
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import StageError
from tactflow.system.files import expanded, is_device, lock, lock_folder, make_folder

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a full disk and an exhausted quota."""
FREE_SPACE = "free some space, or choose another folder"
"""The remedy for them."""


class OutputParams(StageParams):
    """Parameters of a sink that writes a file or a folder."""

    path: str = Field(min_length=1, description="relative to the current directory")
    overwrite: bool = Field(False, description="replace existing output")

    @property
    def refuses_existing(self) -> bool:
        """Whether existing output is an error."""
        return not self.overwrite


class AppendParams(OutputParams):
    """Parameters of a sink that can also continue its output."""

    append: bool = Field(False, description="continue existing output")

    @model_validator(mode="after")
    def _exclusive(self) -> Self:
        if self.overwrite and self.append:
            raise ValueError("overwrite and append exclude each other")
        return self

    @property
    def refuses_existing(self) -> bool:
        """Whether existing output is an error."""
        return not (self.overwrite or self.append)


class OutputSink(Sink):
    """Base class of sinks that write `params.path`, in their own thread."""

    threaded = True

    def __init__(self, params: Any) -> None:
        """Prepare; nothing is opened yet."""
        super().__init__(params)
        self.description = params.path

    @classmethod
    def outputs(cls, params: Any) -> Mapping[str, Path]:
        """The file or folder."""
        return {"path": expanded(params.path)}


def cannot_write(path: Path | str, error: OSError, kept: str = "") -> StageError:
    """The error for a file that cannot be written. kept : what is complete, and the remedy."""
    remedy = FREE_SPACE if error.errno in DISK_FULL else ""
    reason = error.strerror or str(error)
    return StageError(f"{path}: cannot be written: {'; '.join(filter(None, (reason, kept, remedy)))}")


def open_output(
    path: Path, *, overwrite: bool = False, append: bool = False, advice: str = ""
) -> BufferedRandom:
    """Open a file for appending, create its folder, and lock it against other runs until it is closed.

    overwrite, append : accept an existing file, which is otherwise refused unless it is empty. Its content
        stays until the caller truncates it, once nothing else can refuse the run (`Sink.begin`).
    advice : a remedy for an existing file besides overwrite, such as `append: true to continue it, `.

    Raises
    ------
    StageError : another run is writing to it, it exists, it is a pipe or a device, or it cannot be written.
    """
    if is_device(str(path)):
        raise StageError(f"{path}: required a file, not a pipe or device; give another path")
    try:
        make_folder(path.parent)
        # In append mode, no gap of NULs follows if another program truncates the file.
        file = path.open("ab+")
    except OSError as error:
        raise cannot_write(path, error) from error
    try:
        if not lock(file.fileno()):
            raise _taken(path)
        if not (overwrite or append) and os.fstat(file.fileno()).st_size:
            raise StageError(
                f"{path}: this file exists; set overwrite: true to replace it, {advice}or give another path"
            )
    except BaseException:
        file.close()
        raise
    return file


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Create a folder, and lock it against other runs while the block lasts; it is removed if empty then.

    Raises StageError if it cannot be created, or another run is writing to it.
    """
    try:
        make_folder(folder)
        descriptor = lock_folder(folder)
    except BlockingIOError:
        raise _taken(folder) from None
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)
        with suppress(OSError):
            folder.rmdir()


def _taken(path: Path) -> StageError:
    return StageError(f"{path}: another run is writing to it; end that run, or give another path")


def refuse_interference(path: Path, ours: os.stat_result, lost: str, length: int = 0) -> None:
    """Raise StageError if another program has removed, replaced or truncated a file that we write.

    ours : status of the open file. lost : the consequence for our data. length : expected, bytes.
    """
    try:
        current = path.stat()
    except OSError:
        change = "removed"
    else:
        change = "cut" if ours.st_size < length else "" if os.path.samestat(current, ours) else "replaced"
    if change:
        raise StageError(f"{path}: was {change} by another program while the run wrote to it; {lost}")
