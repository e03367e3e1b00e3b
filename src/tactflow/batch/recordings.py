"""Which recordings the words of a command line mean: files, folders, patterns, lists of them."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tactflow.engine.errors import ConfigError, SourceError
from tactflow.sources.base import find_path
from tactflow.sources.files import IMAGE_SUFFIXES, matching, natural_key
from tactflow.sources.lerobot import SCHEME
from tactflow.system.files import expanded, is_utf8

FILE_SUFFIXES = frozenset(
    [
        ".avi",
        ".bag",
        ".h5",
        ".hdf5",
        ".m4v",
        ".mcap",
        ".mkv",
        ".mov",
        ".mp4",
        ".mpeg",
        ".mpg",
        ".npy",
        ".ogv",
        ".webm",
        ".wmv",
    ]
)
"""Files of a folder that are taken for recordings; one that is named is taken whatever it is called."""
FOLDERS = frozenset([".zarr"])
"""Folders that are taken for one recording."""
LISTS = frozenset([".txt", ".list"])
"""Files that name recordings, one a line."""
_SHOWN = 10
"""Mistakes that are told of one call. Chosen by hand: they fit on a terminal."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording to work on.

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
        whole = self.source.removeprefix(SCHEME)
        # A file may be named like a pattern, or as if options followed.
        path = Path(whole) if os.path.exists(whole) else Path(whole.partition("?")[0])
        while ("*" in path.name or "[" in path.name) and not path.exists():
            path = path.parent
        return path


def find_recordings(words: Sequence[str]) -> list[Recording]:
    """The recordings that words name, each once, in natural order within a folder or pattern.

    words : each a file, a folder of pictures, a folder of recordings (with all folders in it), a pattern of
        any of these, `sim:NAME?...`, or a text file with such words, one a line, behind `#` what is no word.

    Raises
    ------
    ConfigError
        If a word names nothing, or something live, or there is nothing at all.

    >>> [recording.name for recording in find_recordings(["sim:press?seed=1", "sim:press?seed=2"])]
    ['sim:press?seed=1', 'sim:press?seed=2']
    """
    mistakes: list[str] = []
    sources = list(dict.fromkeys(_sources(words, None, mistakes, set())))
    # Messages and tables are UTF-8.
    mistakes += [f"{source}: its name is not UTF-8; rename it" for source in sources if not is_utf8(source)]
    if len(mistakes) > _SHOWN:
        mistakes[_SHOWN:] = [f"and {len(mistakes) - _SHOWN} more"]
    if mistakes:
        raise ConfigError(*mistakes)
    if not sources:
        kinds = "video files, .npy, .mcap, folders of pictures"
        raise ConfigError(f"there are no recordings in {', '.join(words) or 'nothing'}; required {kinds}")
    return [Recording(source, name) for source, name in zip(sources, _short_names(sources), strict=True)]


def _sources(
    words: Iterable[str], directory: Path | None, mistakes: list[str], lists: set[Path]
) -> Iterator[str]:
    """Sources that words name; what names none is added to the mistakes.

    lists : those that were read, each once: they may name each other.
    """
    for word in words:
        try:
            yield from _named(word.strip(), directory, mistakes, lists)
        except SourceError as error:
            mistakes.append(str(error))


def _named(word: str, directory: Path | None, mistakes: list[str], lists: set[Path]) -> Iterator[str]:
    if word.startswith("sim:"):
        yield word
        return
    if word.isdecimal() or word.startswith("/dev/") or re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", word):
        mistakes.append(f"{word}: is live; a batch takes recordings. `tactflow record` makes one")
        return
    kind, word = (SCHEME, word.removeprefix(SCHEME)) if word.startswith(SCHEME) else ("", word)
    there = any((base / expanded(word)).exists() for base in (Path(), directory or Path()))
    # A file may be named like a pattern, or as if options followed.
    plain, mark, options = (word, "", "") if there else word.partition("?")
    # In a pattern `?` stands for any character, unless options follow it.
    if glob.has_magic(plain) and not there:
        pattern, tail = (plain, mark + options) if "=" in options else (word, "")
        yield from (kind + found + tail for found in _matching(pattern, directory))
        return
    path = find_path(plain, directory)
    if path.suffix.lower() in LISTS and path.is_file():
        if path.resolve() not in lists:
            lists.add(path.resolve())
            yield from _sources(_lines(path), path.parent, mistakes, lists)
    elif path.is_dir() and not mark and path.suffix.lower() not in FOLDERS:
        found = list(_inside(path))
        if not found:
            mistakes.append(f"{word}: there is no recording in this folder")
        yield from found
    elif path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
        mistakes.append(f"{word}: is one picture; name its folder, or quote the pattern: '{path.parent}/*'")
    else:
        yield kind + _absolute(path) + mark + options


def _matching(pattern: str, directory: Path | None) -> Iterator[str]:
    """What matches: one recording if these are pictures, else each its own."""
    for base in (Path(), directory):
        if base is None:
            continue
        whole = base / expanded(pattern)
        paths = matching(whole)
        if paths and all(path.suffix.lower() in IMAGE_SUFFIXES for path in paths):
            yield _absolute(whole)
            return
        if paths:
            for path in paths:
                if path.is_dir() and path.suffix.lower() not in FOLDERS:
                    yield from _inside(path)
                elif path.suffix.lower() in FILE_SUFFIXES | FOLDERS:
                    yield _absolute(path)
            return
    raise SourceError(f"{pattern}: no file matches this pattern")


def _inside(folder: Path) -> Iterator[str]:
    """A folder with pictures is a recording; else what is in it, and in the folders in it."""
    for place, folders, files in os.walk(folder):
        whole = sorted((n for n in folders if Path(n).suffix.lower() in FOLDERS), key=natural_key)
        folders[:] = sorted((n for n in folders if n[0] != "." and n not in whole), key=natural_key)
        yield from (_absolute(Path(place, name)) for name in whole)
        seen = sorted((name for name in files if name[0] != "."), key=natural_key)
        if any(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in seen):
            yield _absolute(Path(place))
        yield from (_absolute(Path(place, n)) for n in seen if Path(n).suffix.lower() in FILE_SUFFIXES)


def _lines(path: Path) -> list[str]:
    """The words of a text file."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read as a list of recordings: {error}") from error
    # In a name, `#` may stand for itself.
    return [line for line in (re.sub(r"(^|\s)#.*", "", line).strip() for line in lines) if line]


def _absolute(path: Path) -> str:
    return os.path.abspath(path)


def _short_names(sources: Sequence[str]) -> list[str]:
    """The last parts of each path, as many as tell it from the others."""
    names: list[str] = [""] * len(sources)
    left, parts = list(range(len(sources))), 1
    while left:
        tails = {index: _tail(sources[index], parts) for index in left}
        counts: dict[str, int] = {}
        for tail in tails.values():
            counts[tail] = counts.get(tail, 0) + 1
        for index in left:
            names[index] = tails[index]
        left = [index for index in left if counts[tails[index]] > 1 and tails[index] != sources[index]]
        parts += 1
    return names


def _tail(source: str, parts: int) -> str:
    """The last parts of a path; the whole of what is none."""
    if source.startswith("sim:"):
        return source
    pieces = source.split(os.sep)
    return source if parts >= len(pieces) else os.sep.join(pieces[-parts:])
