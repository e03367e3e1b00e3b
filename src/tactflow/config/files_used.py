"""Which files a pipeline reads and writes, so that nothing writes over them."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from tactflow.engine.contract import Sink, StageParams
from tactflow.system.files import expanded, is_device

FileId = tuple[int, int]
"""Device and inode: the same for all names of a file, links too."""


def file_id(path: str | Path) -> FileId | None:
    """What tells a file or folder from all others; None if nothing is there, or a device."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):
        return None
    return found.st_dev, found.st_ino


def files_read(params: BaseModel, directory: Path) -> set[FileId]:
    """The files and folders that parameters name: every text in them that is the path of something.

    directory : where a relative path is looked for besides the current directory. Options behind a `?` are
    left out; a pattern such as `pictures/*.png` stands for its folder.

    >>> from tempfile import NamedTemporaryFile
    >>> class Params(BaseModel):
    ...     source: str
    >>> with NamedTemporaryFile() as file:
    ...     found = files_read(Params(source=f"{file.name}?loop=2"), Path())
    ...     found == {file_id(file.name)}
    True
    """
    found = {file_id(path) for path in files_named(params, directory)}
    return {identity for identity in found if identity is not None}


def files_named(params: BaseModel, directory: Path) -> Iterator[Path]:
    """Every path that parameters may mean: each text in them, as `files_read` takes it."""
    for text in _texts(params.model_dump()):
        names = {text, text.partition("?")[0]}
        # A file may be named like a pattern.
        for name in (names | {_folder_of_pattern(name) for name in names}) - {""}:
            path = expanded(name)
            yield from (path, directory / path)


def files_written(cls: type, params: StageParams) -> list[str]:
    """The files and folders that a sink writes, however they are spelled; no devices. None of a stage."""
    if not issubclass(cls, Sink):
        return []
    paths = [str(output.path) for output in cls.outputs(params)]
    # No file has a name with NUL; the sink will say so.
    return [os.path.realpath(path) for path in paths if "\0" not in path and not is_device(path)]


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str | Path):
        yield str(value)
    elif isinstance(value, dict):
        for item in value.values():
            yield from _texts(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)


def _folder_of_pattern(name: str) -> str:
    # A `?` begins the options.
    while "*" in name or "[" in name:
        name = os.path.dirname(name)
    return name
