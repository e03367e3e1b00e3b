"""Files that a command writes at its end."""

from __future__ import annotations

import os
from pathlib import Path

from tactflow.engine.errors import ConfigError


def refuse_output(option: str, path: Path, *, overwrite: bool) -> None:
    """Find out before the work, not after it, that a file cannot be written.

    option : that names the file.

    Raises
    ------
    ConfigError : there is no folder for it, or it cannot be written into; it is a folder; or it is there
        already and not to be overwritten.
    """
    folder = path.absolute().parent
    if not folder.is_dir():
        raise ConfigError(f"{option}: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"{option}: {folder} cannot be written into")
    if path.is_dir():
        raise ConfigError(f"{option}: {path} is a folder; required a file")
    if path.exists() and not overwrite:
        raise ConfigError(f"{option}: {path} is already there; give --overwrite to replace it")
