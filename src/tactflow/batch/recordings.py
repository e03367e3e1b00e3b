"""Which recordings the words of a command line mean: files, folders, patterns, lists of them."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from tactflow.engine.errors import ConfigError, SourceError
from tactflow.sources.files import IMAGE_SUFFIXES, matching, natural_key
from tactflow.sources.paths import find_path, split_prefix
from tactflow.system.files import expanded, is_utf8

FILE_SUFFIXES = frozenset(
    [
        *(".avi", ".bag", ".h5", ".hdf5", ".m4v", ".mcap", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg"),
        *(".npy", ".ogv", ".webm", ".wmv"),
    ]
)
"""Files of a folder that are recordings; a file that is named is one whatever it is called."""
FOLDERS = frozenset([".zarr"])
"""Folders that are one recording."""
LISTS = frozenset([".txt", ".list"])
"""Files that name recordings, one a line."""
_SHOWN = 10
"""Mistakes that are reported of one call: they fit on a terminal."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording.

    source : what `tactflow run --source` takes, with an absolute path. name : short, for people; no two of a
    call have the same.
    """

    source: str
    name: str

    @property
    def path(self) -> Path | None:
        """The file, or the folder, also of a pattern; None for the simulated sensor."""
        if self.source.startswith("sim:"):
            return None
        _, whole = split_prefix(self.source, None)
        # A file may be named like a pattern, or as if options followed.
        path = Path(whole) if os.path.exists(whole) else Path(whole.partition("?")[0])
        while glob.has_magic(path.name) and not path.exists():
            path = path.parent
        return path


def find_recordings(words: Sequence[str]) -> list[Recording]:
    """The recordings that words name, each once, in natural order within a folder or pattern.

    words : each a file, a folder of pictures, a folder of recordings (with all folders in it), a pattern of
        any of these, `sim:NAME?...`, or a text file of such words, one a line; `#` begins a comment.

    Raises
    ------
    ConfigError
        If a word names nothing, or something live, or there is nothing at all; it has all mistakes.

    >>> [recording.name for recording in find_recordings(["sim:press?seed=1", "sim:press?seed=2"])]
    ['sim:press?seed=1', 'sim:press?seed=2']
    """
    mistakes: list[str] = []
    sources: dict[str, None] = {}
    for word, directory in _with_lists(words, mistakes):
        try:
            sources |= dict.fromkeys(_sources(word, directory))
        except SourceError as error:
            mistakes.append(str(error))
    # Messages and tables are UTF-8.
    mistakes += [f"{source}: its name is not UTF-8; rename it" for source in sources if not is_utf8(source)]
    if len(mistakes) > _SHOWN:
        mistakes[_SHOWN:] = [f"and {len(mistakes) - _SHOWN} more"]
    if mistakes:
        raise ConfigError(*mistakes)
    if not sources:
        kinds = "video files, .npy, .mcap, folders of pictures"
        raise ConfigError(f"there are no recordings in {', '.join(words) or 'nothing'}; required {kinds}")
    names = _short_names(list(sources))
    return [Recording(source, name) for source, name in zip(sources, names, strict=True)]


def _with_lists(words: Iterable[str], mistakes: list[str]) -> Iterator[tuple[str, Path | None]]:
    """The words, and in the place of a list those in it, with its folder."""
    for word in words:
        path = expanded(word)
        if path.suffix.lower() not in LISTS or not path.is_file():
            yield word, None
            continue
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            mistakes.append(f"{path}: cannot be read as a list of recordings: {error}")
            continue
        # In a name, `#` may stand for itself.
        kept = (re.sub(r"(^|\s)#.*", "", line).strip() for line in lines)
        yield from ((line, path.parent) for line in kept if line)


def _sources(word: str, directory: Path | None) -> Iterator[str]:
    """The sources that one word names; raises SourceError. directory : of the list that names it."""
    if word.startswith("sim:"):
        yield word
        return
    if word.isdecimal() or word.startswith("/dev/") or re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", word):
        raise SourceError(f"{word}: is live; a batch takes recordings. `tactflow record` makes one")
    scheme, word = split_prefix(word, directory)
    exists = any((base / expanded(word)).exists() for base in (Path(), directory or Path()))
    # A file may be named like a pattern, or as if options followed.
    plain, mark, options = (word, "", "") if exists else word.partition("?")
    if glob.has_magic(plain) and not exists:
        # In a pattern `?` stands for any character, unless options follow it.
        pattern, tail = (plain, mark + options) if "=" in options else (word, "")
        yield from (scheme + found + tail for found in _matching(pattern, directory))
        return
    path = find_path(plain, directory)
    if path.suffix.lower() in LISTS and path.is_file():
        raise SourceError(f"{word}: is a list of recordings; a list cannot name another one")
    if path.is_dir() and not mark and path.suffix.lower() not in FOLDERS:
        found = list(_inside(path))
        if not found:
            raise SourceError(f"{word}: there is no recording in this folder")
        yield from found
    elif path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
        raise SourceError(f"{word}: is one picture; name its folder, or quote the pattern: '{path.parent}/*'")
    else:
        yield scheme + os.path.abspath(path) + mark + options


def _matching(pattern: str, directory: Path | None) -> Iterator[str]:
    """The matches of a pattern: one recording if all are pictures, else each its own."""
    whole = expanded(pattern)
    paths = matching(whole)
    if not paths and directory is not None:
        whole = directory / whole
        paths = matching(whole)
    if not paths:
        raise SourceError(f"{pattern}: no file matches this pattern")
    if all(path.suffix.lower() in IMAGE_SUFFIXES for path in paths):
        yield os.path.abspath(whole)
        return
    for path in paths:
        if path.is_dir() and path.suffix.lower() not in FOLDERS:
            yield from _inside(path)
        elif path.suffix.lower() in FILE_SUFFIXES | FOLDERS:
            yield os.path.abspath(path)


def _inside(folder: Path) -> Iterator[str]:
    """The recordings in a folder and all folders in it; a folder with pictures is one."""
    for place, folders, files in os.walk(folder):
        whole = sorted((n for n in folders if Path(n).suffix.lower() in FOLDERS), key=natural_key)
        folders[:] = sorted((n for n in folders if n[0] != "." and n not in whole), key=natural_key)
        names = sorted((name for name in files if name[0] != "."), key=natural_key)
        if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in names):
            yield os.path.abspath(place)
        for name in (*whole, *(n for n in names if Path(n).suffix.lower() in FILE_SUFFIXES)):
            yield os.path.abspath(Path(place, name))


def _short_names(sources: Sequence[str]) -> list[str]:
    """The last parts of each path, as many as tell it from the others."""
    names: dict[str, str] = {}
    for parts in count(1):
        left = [source for source in sources if source not in names]
        if not left:
            return [names[source] for source in sources]
        tails = [_tail(source, parts) for source in left]
        counts = Counter(tails)
        pairs = zip(left, tails, strict=True)
        names |= {source: tail for source, tail in pairs if counts[tail] == 1 or tail == source}
    raise AssertionError("a path has an end")


def _tail(source: str, parts: int) -> str:
    """The last parts of a path; anything else as it is."""
    if source.startswith("sim:"):
        return source
    pieces = source.split(os.sep)
    return source if parts >= len(pieces) else os.sep.join(pieces[-parts:])
