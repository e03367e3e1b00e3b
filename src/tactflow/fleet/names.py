"""File names of each sensor's process, made from one name given for all of them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from tactflow.config.sensors import PLACEHOLDER
from tactflow.engine.errors import ConfigError
from tactflow.system.files import expanded, is_device

STREAMS = ("/dev/stdout", "/dev/stderr")
"""Streams that lead to the supervisor, even if they are redirected to a regular file."""


def with_name(path: str, sensor: str) -> str:
    """The file that one sensor's process writes, given the `path` on the command line.

    Standard output and devices are shared by all.

    Raises
    ------
    ConfigError : the path is a folder.

    >>> with_name("out.jsonl", "left")
    'out-left.jsonl'
    >>> with_name("{sensor}/out.jsonl", "left")
    'left/out.jsonl'
    """
    if path == "-" or path in STREAMS or is_device(path):
        return path
    named = path.replace(PLACEHOLDER, sensor)
    if named == path and not _is_folder(path):
        whole = Path(path)
        named = str(whole.with_name(f"{whole.stem}-{sensor}{whole.suffix}"))
    if _is_folder(named):
        example = os.path.join(named, f"{PLACEHOLDER}.json")
        raise ConfigError(f"required a file, not a folder; each sensor writes its own, as in {example}")
    return named


def name_problems(files: Mapping[str, str], sensors: Sequence[str]) -> list[str]:
    """Error messages for options whose path cannot be split by sensor.

    files : option -> path.
    """
    problems = []
    for option, path in files.items():
        try:
            for sensor in sensors:
                with_name(path, sensor)
        except ConfigError as error:
            problems.append(f"{option} {path}: {error}")
    return problems


def _is_folder(path: str) -> bool:
    return os.path.basename(path) in ("", ".", "..") or expanded(path).is_dir()
