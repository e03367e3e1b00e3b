"""The files that a pipeline reads and writes, so that no sink overwrites an input."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from tactflow.engine.contract import Sink, StageParams
from tactflow.system.files import expanded, is_device


def files_named(params: BaseModel, directory: Path) -> Iterator[Path]:
    """The existing files and folders that texts in the parameters name, also with options after a `?`.

    directory : for relative paths, besides the current directory.
    """
    for text in _texts(params.model_dump()):
        for name in {text, text.partition("?")[0]} - {""}:
            paths = (expanded(name), directory / expanded(name))
            yield from (path for path in paths if os.path.exists(path) and not is_device(str(path)))


def files_written(cls: type, params: StageParams) -> list[str]:
    """The real paths of the files and folders that a sink writes, without devices; empty for a stage."""
    if not issubclass(cls, Sink):
        return []
    paths = [str(path) for path in cls.outputs(params).values()]
    # The sink reports names with NUL, which no file can have.
    return [os.path.realpath(path) for path in paths if "\0" not in path and not is_device(path)]


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str | Path):
        yield str(value)
    elif isinstance(value, dict | list | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts(item)
