"""Paths of sources, and their settings: `bag.mcap?topic=/camera/image`."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import parse_qsl

from tactflow.engine.errors import SourceError
from tactflow.system.files import expanded, is_device

MAX_LISTED_NAMES = 20
"""Maximum number of names in a message. Chosen by hand."""


def locate(spec: str, directory: Path | None) -> Path | None:
    """The file or folder in the current directory, or else in `directory`; None if there is none."""
    paths = (base / expanded(spec) for base in (Path(), directory or Path()))
    return next((path for path in paths if path.exists()), None)


def split_prefix(spec: str, directory: Path | None) -> tuple[str, str]:
    """The prefix of a path with its colon, or "", and the path.

    >>> split_prefix("lerobot:datasets/press", None), split_prefix("press.avi", None)
    (('lerobot:', 'datasets/press'), ('', 'press.avi'))
    """
    prefix, colon, path = spec.partition(":")
    # A single letter is a Windows drive.
    if len(prefix) < 2 or not colon or not prefix.isidentifier() or locate(spec.partition("?")[0], directory):
        return "", spec
    return prefix + colon, path


def find_path(spec: str, directory: Path | None) -> Path:
    """Resolve a path of the command line or a pipeline file; `~` is expanded.

    Raises SourceError if it does not exist, with similar names, and for a pipe or a device, because opening
    it may block forever, regardless of signals.
    """
    path = locate(spec, directory)
    if path is None:
        candidates = dict.fromkeys(base / expanded(spec) for base in (Path(), directory or Path()))
        raise SourceError(f"{spec}: no such file or folder{_suggestion(list(candidates))}")
    if is_device(str(path)):
        raise SourceError(f"{spec}: is a pipe or a device, not a file")
    return path


def _suggestion(candidates: list[Path]) -> str:
    for path in candidates:
        folder, wanted = path.parent, path.name
        # Go up to the first existing folder, to find a typo in the middle of a path.
        while not folder.is_dir() and folder.parent != folder:
            folder, wanted = folder.parent, folder.name
        with suppress(OSError):
            close = difflib.get_close_matches(wanted, sorted(os.listdir(folder)), n=3, cutoff=0.6)
            if close:
                return "; did you mean " + " or ".join(str(folder / name) for name in close) + "?"
    return f" (looked in {', '.join(str(path.parent.absolute()) for path in candidates)})"


def split_query(spec: str, directory: Path | None, known: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The path and the settings of a source, `path?name=value&name=value`; `%26` stands for &.

    A file with a ? in its name takes precedence. known : name -> description. Raises SourceError if a setting
    is unknown, empty or repeated.

    >>> split_query("bag.mcap?topic=/gel/image", None, {"topic": "name of a topic"})
    ('bag.mcap', {'topic': '/gel/image'})
    """
    name, mark, query = spec.partition("?")
    if not mark or locate(spec, directory):
        return spec, {}
    settings: dict[str, str] = {}
    for key, value in parse_qsl(query.replace("+", "%2B"), keep_blank_values=True):
        if key not in known or key in settings or not value:
            raise SourceError(f"{spec}: {key}={value}: required {describe_settings(known)}")
        settings[key] = value
    return name, settings


def listed(names: Sequence[str]) -> str:
    """The first names, for a message: "a, b and 3 more"; "none" if there are none."""
    more = f" and {len(names) - MAX_LISTED_NAMES} more" if len(names) > MAX_LISTED_NAMES else ""
    return (", ".join(names[:MAX_LISTED_NAMES]) or "none") + more


def describe_settings(known: Mapping[str, str]) -> str:
    """The valid settings as `name=description`."""
    return ", ".join(f"{setting}={meaning}" for setting, meaning in known.items())
