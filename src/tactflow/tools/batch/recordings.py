"""Resolve the recordings named on a command line: files, folders and patterns."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tactflow.engine.errors import ConfigError, SourceError
from tactflow.sources import recording_suffixes
from tactflow.sources.files import IMAGE_SUFFIXES, matching, natural_key
from tactflow.sources.paths import find_path, locate, split_prefix
from tactflow.system.files import expanded, is_utf8


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording.

    Attributes
    ----------
    source : as for `tactflow run --source`, with an absolute path.
    name : short display name, unique within a call.
    """

    source: str
    name: str

    @property
    def path(self) -> Path | None:
        """File or folder, also that of a pattern; None for the simulated sensor."""
        if self.source.startswith("sim:"):
            return None
        _, name = split_prefix(self.source, None)
        # The name of an existing file may contain wildcards or a question mark.
        path = Path(name) if os.path.exists(name) else Path(name.partition("?")[0])
        while glob.has_magic(path.name) and not path.exists():
            path = path.parent
        return path


def find_recordings(words: Sequence[str]) -> list[Recording]:
    """Find the recordings that words name, without duplicates, in natural order within a folder or pattern.

    words : each a file, a folder of pictures, a folder of recordings (searched recursively), a pattern of any
        of these, or `sim:NAME?...`.

    Raises
    ------
    ConfigError
        A word matches nothing or names a live source; lists all mistakes.

    >>> [recording.name for recording in find_recordings(["sim:press?seed=1", "sim:press?seed=2"])]
    ['sim:press?seed=1', 'sim:press?seed=2']
    """
    mistakes: list[str] = []
    sources: dict[str, None] = {}
    for word in words:
        try:
            sources |= dict.fromkeys(_sources(word))
        except SourceError as error:
            mistakes.append(str(error))
    # Messages and tables are UTF-8.
    mistakes += [f"{source}: the name is not UTF-8; rename it" for source in sources if not is_utf8(source)]
    if mistakes:
        raise ConfigError(*mistakes)
    names = _short_names(list(sources))
    return [Recording(source, name) for source, name in zip(sources, names, strict=True)]


def _sources(word: str) -> Iterator[str]:
    """The sources that a word names; raises SourceError."""
    if word.startswith("sim:"):
        yield word
        return
    if word.isdecimal() or word.startswith("/dev/") or re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", word):
        raise SourceError(f"{word}: is a live source; a batch needs recordings: see `tactflow record`")
    scheme, word = split_prefix(word, None)
    exists = locate(word, None) is not None
    # The name of an existing file may contain wildcards or a question mark.
    plain, mark, options = (word, "", "") if exists else word.partition("?")
    if glob.has_magic(plain) and not exists:
        # In a pattern, `?` is a wildcard unless options follow.
        pattern, tail = (plain, mark + options) if "=" in options else (word, "")
        yield from (scheme + match + tail for match in _matching(pattern))
        return
    path = find_path(plain, None)
    if path.is_dir() and not mark and not _is_recording(path.name):
        recordings = list(_inside(path))
        if not recordings:
            raise SourceError(f"{word}: this folder contains no recordings")
        yield from recordings
    elif path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
        raise SourceError(
            f"{word}: is a single picture; name its folder, or quote a pattern: '{path.parent}/*'"
        )
    else:
        yield scheme + os.path.abspath(path) + mark + options


def _matching(pattern: str) -> Iterator[str]:
    """Matches of a pattern; if all are pictures, they form a single recording."""
    full = expanded(pattern)
    paths = matching(full)
    if not paths:
        raise SourceError(f"{pattern}: no file matches this pattern")
    if all(path.suffix.lower() in IMAGE_SUFFIXES for path in paths):
        yield os.path.abspath(full)
        return
    for path in paths:
        if _is_recording(path.name):
            yield os.path.abspath(path)
        elif path.is_dir():
            yield from _inside(path)


def _is_recording(name: str) -> bool:
    """Whether a file or folder found in a folder is a recording; one named explicitly may have any suffix."""
    return not name.startswith(".") and name.lower().endswith(tuple(recording_suffixes()))


def _inside(folder: Path) -> Iterator[str]:
    """Recordings in a folder and its subfolders; a folder of pictures is a single recording."""
    for parent, folders, files in os.walk(folder):
        stores = [name for name in folders if _is_recording(name)]
        folders[:] = sorted((n for n in folders if n[0] != "." and n not in stores), key=natural_key)
        names = [name for name in files if name[0] != "."]
        if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in names):
            yield os.path.abspath(parent)
        for found in (stores, filter(_is_recording, names)):
            yield from (os.path.abspath(Path(parent, name)) for name in sorted(found, key=natural_key))


def _short_names(sources: Sequence[str]) -> list[str]:
    """Sources without the folders that all recordings share; simulated ones unchanged."""
    # Options, such as `?topic=/gel`, are not part of the path.
    paths = [source.partition("?")[0] for source in sources if not source.startswith("sim:")]
    shared = os.path.commonprefix(paths)  # noqa: RUF071 - a path may follow a prefix such as lerobot:
    shared = shared[: shared.rfind(os.sep) + 1]
    return [source.removeprefix(shared) for source in sources]
