"""Output files of a run: their parameters, creating them, and detecting interference."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from tactflow.engine.contract import StageParams
from tactflow.engine.errors import StageError
from tactflow.system.files import is_device, make_folder


class AppendParams(StageParams):
    """Parameters of a sink that can replace or continue its output."""

    path: str = Field(min_length=1, description="relative to the current directory")
    overwrite: bool = Field(False, description="replace existing output")
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


def cannot_write(path: Path | str, error: OSError, kept: str = "") -> StageError:
    """The error for a file that cannot be written. kept : what is complete, and the remedy."""
    return StageError(f"{path}: cannot be written: {error.strerror or error}{kept and f'; {kept}'}")


def refuse_existing(path: Path, *, overwrite: bool, advice: str = "") -> None:
    """Raise StageError for an existing file, unless it may be replaced, and for a pipe or device.

    advice : another remedy, such as `append: true to continue it, `.
    """
    if path.exists() and not path.is_dir() and not overwrite:
        raise StageError(
            f"{path}: this file exists; set overwrite: true to replace it, {advice}or give another path"
        )
    if is_device(str(path)):
        raise StageError(f"{path}: required a file, not a pipe or device; give another path")


def create(path: Path, *, overwrite: bool) -> None:
    """Create an empty file and its folder, or truncate an existing file with `overwrite`.

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
