"""YAML with places: every key and value knows where it was written; mistakes are shown with a caret."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Mark

_LINE_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
_MAX_BYTES = 256 * 1024
"""Size of a pipeline file; a hundred times the longest of ours. Reading such a file takes some seconds."""
_MAX_VALUES = 100_000
"""Values of a document, aliases written out: more is a bomb, not a pipeline. Chosen by hand."""
_MAX_SHOWN = 150
_MAX_MESSAGE = 2000
"""Characters of a source line, and of a whole message, that are shown. Chosen by hand."""


@dataclass(slots=True)
class Item:
    """A value of a YAML document and its place.

    content : a scalar, a list of `Item`, or a dict of `Entry` by key.
    """

    content: Any
    mark: Mark

    @property
    def entries(self) -> dict[str, Entry]:
        """The entries of a mapping; none for a null, which is what `key:` with nothing after it means."""
        return self.content if isinstance(self.content, dict) else {}

    @property
    def is_mapping(self) -> bool:
        """True for a mapping and for a null."""
        return isinstance(self.content, dict) or self.content is None

    def plain(self) -> Any:
        """The value without places."""
        if isinstance(self.content, dict):
            return {key: entry.item.plain() for key, entry in self.content.items()}
        if isinstance(self.content, list):
            return [item.plain() for item in self.content]
        return self.content

    def words(self) -> str:
        """The value as it is shown in a message."""
        if isinstance(self.content, dict):
            return "a mapping"
        if isinstance(self.content, list):
            return "a list"
        return shown(self.content)


@dataclass(slots=True)
class Entry:
    """One `key: value` of a mapping."""

    mark: Mark
    item: Item


def shown(value: Any) -> str:
    """A plain value as YAML would write it, short."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def wrap(value: Any, mark: Mark) -> Item:
    """Give a plain value (from the command line or a program) one place."""
    if isinstance(value, Mapping):
        return Item({str(key): Entry(mark, wrap(part, mark)) for key, part in value.items()}, mark)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return Item([wrap(part, mark) for part in value], mark)
    return Item(value, mark)


@dataclass(slots=True)
class Problems:
    """Mistakes found so far; all of them are reported at once.

    lines : file -> its lines, to show the one with the mistake.
    """

    lines: dict[str, list[str]] = field(default_factory=dict)
    found: dict[tuple[Mark, str], None] = field(default_factory=dict)

    def add(self, mark: Mark, message: str) -> None:
        """Record one mistake; one that is known already is not told twice."""
        self.found[mark, message] = None

    def raise_if_any(self) -> None:
        """Raise a ConfigError that holds every mistake, in the order of the file."""
        if not self.found:
            return
        found = sorted(self.found, key=lambda item: (item[0].line == 0, item[0].line, item[0].column))
        raise ConfigError(*[self._block(mark, message) for mark, message in found])

    def _block(self, mark: Mark, message: str) -> str:
        # A place has two blanks after it; an option reads as a sentence.
        message = _one_line(message)
        head = f"{mark}  {message}" if mark.line else f"{_one_line(str(mark))}: {message}"
        lines = self.lines.get(mark.file, [])
        if not 0 < mark.line <= len(lines):
            return head
        line, column = lines[mark.line - 1], mark.column - 1
        start = max(0, column - _MAX_SHOWN // 2) if len(line) > _MAX_SHOWN else 0
        line = line[start : start + _MAX_SHOWN]
        indent = "".join("\t" if letter == "\t" else " " for letter in line[: column - start])
        visible = "".join(letter if letter.isprintable() or letter == "\t" else "?" for letter in line)
        return f"{head}\n    {visible}\n    {indent}^"


def _one_line(text: str) -> str:
    """Text from a file, safe to print: no line breaks or control characters, not endless."""
    text = "".join(letter if letter.isprintable() else " " for letter in text)
    return text if len(text) <= _MAX_MESSAGE else text[:_MAX_MESSAGE] + " ..."


class _Loader(yaml.SafeLoader):
    """YAML's plain values; dates stay text, and 1e-3 is a number as in YAML 1.2."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, regexp) for tag, regexp in resolvers if not tag.endswith((":timestamp", ":value"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)

_PLAIN_TAGS = frozenset(f"tag:yaml.org,2002:{name}" for name in ("null", "bool", "int", "float", "str"))
_MERGE = "tag:yaml.org,2002:merge"


def read_yaml(path: Path, problems: Problems) -> Item:
    """Read a YAML file into items with places.

    Raises
    ------
    ConfigError : the file cannot be read or is not YAML. Duplicate keys and the like are added to `problems`.
    """
    file = str(path)
    if path.is_dir():
        raise ConfigError(f"{file} is a folder; required: a pipeline file (YAML)")
    try:
        with path.open("rb") as stream:
            # A device such as /dev/zero has no end.
            data = stream.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"there is no file {file}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(f"cannot read {file}: {reason}") from None
    if len(data) > _MAX_BYTES:
        raise ConfigError(f"{file} is larger than {_MAX_BYTES // 1024} KiB; required: a pipeline file (YAML)")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = _LINE_BREAK.split(data[: error.start].decode("utf-8-sig", "replace"))
        problems.lines[file] = _LINE_BREAK.split(data.decode("utf-8-sig", "replace"))
        mark = Mark(file, len(before), len(before[-1]) + 1)
        problems.add(mark, f"byte 0x{data[error.start]:02x} is not UTF-8 text; save the file as UTF-8")
        problems.raise_if_any()
        raise
    problems.lines[file] = _LINE_BREAK.split(text)
    return _parse(text, file, problems)


def read_value(text: str, mark: Mark, problems: Problems) -> Item | None:
    """Read a value given on the command line; every part of it has the place `mark`."""
    inner = Problems()
    try:
        item = _parse(text, "", inner)
        inner.raise_if_any()
    except ConfigError:
        for _, message in inner.found:
            problems.add(mark, message)
        return None
    return wrap(item.plain(), mark)


def _parse(text: str, file: str, problems: Problems) -> Item:
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            return (
                Item(None, Mark(file, 1, 1))
                if node is None
                else _Converter(loader, file, problems).item(node)
            )
        finally:
            loader.dispose()
    except yaml.reader.ReaderError as error:
        before = _LINE_BREAK.split(text[: error.position])
        mark = Mark(file, len(before), len(before[-1]) + 1)
        problems.add(mark, f"the character #x{ord(text[error.position]):04x} is not allowed in YAML")
    except yaml.MarkedYAMLError as error:
        where = error.problem_mark or error.context_mark
        mark = Mark(file, where.line + 1, where.column + 1) if where else Mark(file, 1, 1)
        problems.add(mark, _yaml_words(error, text))
    except RecursionError:
        problems.add(Mark(file, 1, 1), "not a pipeline: values are nested too deeply")
    problems.raise_if_any()
    raise AssertionError("unreachable: every branch above added a problem")


def _yaml_words(error: yaml.MarkedYAMLError, text: str) -> str:
    problem = " ".join(str(error.problem or error.context or "it cannot be read").split())
    where = error.problem_mark
    if where is not None:
        line = [*_LINE_BREAK.split(text), ""][where.line]
        if "\t" in line[: where.column + 1]:
            return "a tab character; YAML is indented with blanks"
    if "expected a single document" in str(error.context):
        return "a second document starts here; a pipeline file holds one"
    context = f" {error.context}" if error.context and error.problem else ""
    if error.context_mark is not None and context:
        context += f" that starts in line {error.context_mark.line + 1}"
    hint = "; text with ': ' in it needs quotes" if "mapping values are not allowed" in problem else ""
    return f"not valid YAML: {problem}{context}{hint}"


class _Converter:
    """Turns composed nodes into items. Aliases share their item."""

    def __init__(self, loader: _Loader, file: str, problems: Problems) -> None:
        self._loader = loader
        self._file = file
        self._problems = problems
        self._done: dict[int, Item] = {}
        self._sizes: dict[int, int] = {}
        self._open: set[int] = set()

    def item(self, node: yaml.Node) -> Item:
        key = id(node)
        if key in self._done:
            return self._done[key]
        mark = self._mark(node)
        if key in self._open:
            self._problems.add(mark, "this value contains itself")
            return Item(None, mark)
        self._open.add(key)
        content, size = self._content(node)
        self._open.discard(key)
        if size > _MAX_VALUES:
            # Aliases of aliases grow exponentially; a short file must not fill the memory.
            self._problems.add(mark, f"this value unfolds to more than {_MAX_VALUES} values")
            content, size = None, 1
        self._sizes[key] = size
        return self._done.setdefault(key, Item(content, mark))

    def _mark(self, node: yaml.Node) -> Mark:
        return Mark(self._file, node.start_mark.line + 1, node.start_mark.column + 1)

    def _size(self, node: yaml.Node) -> int:
        return self._sizes.get(id(node), 1)

    def _content(self, node: yaml.Node) -> tuple[Any, int]:
        if isinstance(node, yaml.MappingNode) and node.tag == "tag:yaml.org,2002:map":
            entries = self._entries(node)
            return entries, 1 + sum(self._size(value) for _, value in node.value)
        if isinstance(node, yaml.SequenceNode) and node.tag == "tag:yaml.org,2002:seq":
            items = [self.item(part) for part in node.value]
            return items, 1 + sum(self._size(part) for part in node.value)
        if isinstance(node, yaml.ScalarNode) and node.tag in _PLAIN_TAGS:
            return self._scalar(node), 1
        tag = node.tag.replace("tag:yaml.org,2002:", "!!")
        self._problems.add(self._mark(node), f"the tag {tag} is not allowed; write plain values")
        return None, 1

    def _scalar(self, node: yaml.ScalarNode) -> Any:
        try:
            value = self._loader.construct_object(node)
            # An escape such as "\ud800" makes text that cannot be written anywhere.
            str(value).encode()
            return value
        except Exception:
            kind = node.tag.rpartition(":")[2]
            self._problems.add(self._mark(node), f"{node.value!r} is not a valid {kind}")
            return None

    def _entries(self, node: yaml.MappingNode) -> dict[str, Entry]:
        entries: dict[str, Entry] = {}
        merged: dict[str, Entry] = {}
        for key_node, value_node in node.value:
            if key_node.tag == _MERGE:
                merged = dict(self._merged(value_node)) | merged
                continue
            mark = self._mark(key_node)
            item = self.item(value_node)
            key = self._key(key_node)
            if key is None:
                continue
            if key in entries:
                first = entries[key].mark
                self._problems.add(
                    mark, f"{key}: duplicate key; it is already in line {first.line}, column {first.column}"
                )
                continue
            entries[key] = Entry(mark, item)
        return entries | {key: entry for key, entry in merged.items() if key not in entries}

    def _key(self, node: yaml.Node) -> str | None:
        if isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:str":
            value = self._scalar(node)
            return None if value is None else str(value)
        hint = (
            f"; put it in quotes if {node.value} is meant as text"
            if isinstance(node, yaml.ScalarNode)
            else ""
        )
        self._problems.add(self._mark(node), f"a key must be text{hint}")
        return None

    def _merged(self, node: yaml.Node) -> Iterator[tuple[str, Entry]]:
        # Of several mappings the first one wins, so it comes last.
        for part in reversed(node.value) if isinstance(node, yaml.SequenceNode) else [node]:
            item = self.item(part)
            if not isinstance(item.content, dict):
                self._problems.add(self._mark(part), "<<: takes a mapping, or a list of mappings")
            yield from item.entries.items()
