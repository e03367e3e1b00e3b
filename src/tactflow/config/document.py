"""A pipeline file as plain values with their locations; errors are shown with source line and caret."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Mark
from tactflow.system.files import read_limited

SOURCE_OPTION = "a camera, a recording or a stream is given as --source"
"""Advice for an argument that is not the name of a pipeline."""
Keys = tuple[str | int, ...]
"""Path of a value in a document: keys of mappings and indices of lists, from the root."""


def shown(value: Any) -> str:
    """A plain value as YAML would write it, shortened."""
    if value is None or isinstance(value, bool):
        return "nothing" if value is None else str(value).lower()
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def described(value: Any) -> str:
    """A value as shown in messages."""
    return "a mapping" if isinstance(value, dict) else "a list" if isinstance(value, list) else shown(value)


def dotted(keys: Sequence[str | int]) -> str:
    """A path as shown in messages.

    >>> dotted(("stages", "preprocess", "corners", 0))
    'stages.preprocess.corners.0'
    """
    return ".".join(map(str, keys))


class Document:
    """The values of a pipeline file, the location of each, and the errors found so far.

    root : mappings, lists, text, numbers, booleans and None. file : its name in messages; or the origin of
    values outside a file, such as an option of the command line.
    """

    def __init__(self, file: str, root: Any = None, *, line: int = 0) -> None:
        self.root = root
        self.lines: list[str] = []
        self.marks: dict[Keys, Mark] = {(): Mark(file, line, line)}
        self.mistakes: dict[tuple[Mark, str], None] = {}

    def get(self, *keys: str | int) -> Any:
        """The value at a path, or None."""
        value = self.root
        for key in keys:
            try:
                value = value[key]
            except (LookupError, TypeError):
                return None
        return value

    def mapping(self, *keys: str | int) -> dict[str, Any]:
        """The mapping at a path; empty if it is not a mapping."""
        value = self.get(*keys)
        return value if isinstance(value, dict) else {}

    def has(self, *keys: str | int) -> bool:
        """Whether a mapping of the document has this key."""
        return keys[-1] in self.mapping(*keys[:-1])

    def mark(self, *keys: str | int) -> Mark:
        """The location of the key of a value, or of an item of a list; for a missing value, of the mapping
        around it."""
        return self.marks.get(keys) or self.mark(*keys[:-1])

    def set(self, keys: Keys, value: Any, mark: Mark) -> None:
        """Set a value, which is located at `mark`, and create the mappings around it if needed.

        Raises
        ------
        ConfigError : the path leads through a value that is not a mapping.
        """
        parent, place = self.root, keys
        for depth, key in enumerate(keys[:-1], start=1):
            if parent.get(key) is None:
                parent[key] = {}
                place = place[:depth]
            parent = parent[key]
            if not isinstance(parent, dict):
                problem = f"{dotted(keys[:depth])} is {described(parent)}"
                raise ConfigError(f"{problem}, so it has no {keys[depth]}; replace it as a whole")
        parent[keys[-1]] = value
        # Discard the locations inside the old value.
        self.marks = {keys: known for keys, known in self.marks.items() if keys[: len(place)] != place}
        self.marks[place] = mark

    def report(self, keys: Keys, message: str) -> None:
        """Record an error in a value."""
        self.report_at(self.mark(*keys), f"{dotted(keys)}: {message}" if keys else message)

    def report_at(self, mark: Mark, message: str) -> None:
        """Record an error at a location, once."""
        self.mistakes[mark, message] = None

    def raise_if_mistaken(self) -> None:
        """Raise a ConfigError with all errors, those of the file in its order."""
        if self.mistakes:
            ordered = sorted(self.mistakes, key=lambda item: (not item[0].line, item[0].line, item[0].column))
            raise ConfigError(*[self._block(mark, message) for mark, message in ordered])

    def _block(self, mark: Mark, message: str) -> str:
        # Text from a file may hold line breaks and control characters.
        message = _printable(message)
        head = f"{mark}  {message}" if mark.line else f"{_printable(mark.file)}: {message}"
        if not 0 < mark.line <= len(self.lines):
            return head
        return f"{head}\n    {_printable(self.lines[mark.line - 1])}\n    {' ' * (mark.column - 1)}^"


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)


def read_document(path: Path) -> Document:
    """Read a YAML file. Errors such as duplicate keys are recorded in the document.

    Raises
    ------
    ConfigError : the file cannot be read, or is not YAML.
    """
    if path.is_dir():
        raise ConfigError(f"{path} is a folder; required: a pipeline file (YAML); {SOURCE_OPTION} {path}")
    hint = "" if path.suffix in (".yaml", ".yml") else f"; {SOURCE_OPTION} {path}"
    try:
        data = read_limited(path)
    except FileNotFoundError:
        raise ConfigError(f"there is no file {path}{hint}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(f"cannot read {path}: {reason}{hint}") from None
    document = Document(str(path), line=1)
    # YAML does not allow the characters that bytes other than UTF-8 become.
    text = data.decode("utf-8-sig", "surrogateescape")
    document.lines = text.splitlines()
    if not _parse(text, document):
        document.raise_if_mistaken()
    return document


def parse_value(text: str) -> Any:
    """Parse a YAML value of the command line.

    Raises
    ------
    ConfigError : invalid YAML; the message has no location.

    >>> parse_value("[1, 2e-3]")
    [1, 0.002]
    """
    document = Document("", line=1)
    _parse(text, document)
    if document.mistakes:
        raise ConfigError(*[message for _, message in document.mistakes])
    return document.root


class _Loader(yaml.SafeLoader):
    """Plain YAML values; dates stay text, and 1e-3 is a number as in YAML 1.2."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, regexp) for tag, regexp in resolvers if not tag.endswith((":timestamp", ":value"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)

_TAG = "tag:yaml.org,2002:"
_SCALARS = frozenset(_TAG + name for name in ("null", "bool", "int", "float", "str"))


def _parse(text: str, document: Document) -> bool:
    """Fill a document from YAML. Returns False, and records the error, if it cannot be parsed."""
    file = document.mark().file
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is not None:
            values = _Values(loader, document)
            document.marks[()] = values.mark(node)
            document.root = values.value(node, ())
        return True
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        mark = Mark(file, before.count("\n") + 1, len(before) - before.rfind("\n"))
        what = f"the character #x{error.character:04x} is not allowed in YAML"
        document.report_at(mark, f"{what}; save the file as UTF-8 text")
    except yaml.MarkedYAMLError as error:
        where = error.problem_mark or error.context_mark
        mark = Mark(file, where.line + 1, where.column + 1) if where else Mark(file, 1, 1)
        document.report_at(mark, _yaml_message(error, text))
    except RecursionError:
        document.report_at(Mark(file, 1, 1), "not a pipeline: values are nested too deeply")
    return False


def _yaml_message(error: yaml.MarkedYAMLError, text: str) -> str:
    """PyYAML's message, with advice for common mistakes."""
    where = error.problem_mark
    if where is not None and "\t" in [*text.splitlines(), ""][where.line][: where.column + 1]:
        return "a tab character; YAML is indented with blanks"
    around = ""
    if error.context and error.context_mark:
        around = f"{error.context} that starts in line {error.context_mark.line + 1}: "
    hint = "; text with ': ' in it needs quotes" if "mapping values are not" in str(error.problem) else ""
    return f"not valid YAML: {around}{error.problem}{hint}"


class _Values:
    """Converts PyYAML's nodes to values and records their locations; aliases are expanded."""

    def __init__(self, loader: _Loader, document: Document) -> None:
        self._loader = loader
        self._document = document

    def value(self, node: yaml.Node, keys: Keys) -> Any:
        """The plain value of a node at a path."""
        self._document.marks.setdefault(keys, self.mark(node))
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node, keys)
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self.value(part, (*keys, index)) for index, part in enumerate(node.value)]
        if not isinstance(node, yaml.ScalarNode) or node.tag not in _SCALARS:
            self._report(node, f"the tag {node.tag.replace(_TAG, '!!')} is not allowed; write plain values")
            return None
        try:
            return self._loader.construct_object(node)
        except (ValueError, LookupError):
            self._report(node, f"{node.value!r} is not a valid {node.tag.removeprefix(_TAG)}")
            return None

    def _mapping(self, node: yaml.MappingNode, keys: Keys) -> dict[str, Any]:
        first: dict[str, yaml.Mark] = {}
        for key_node, _ in node.value:
            if key_node.tag == _TAG + "merge":
                continue
            key, mark = key_node.value, key_node.start_mark
            if key_node.tag != _TAG + "str":
                hint = f"; put {key} in quotes" if isinstance(key, str) else ""
                self._report(key_node, f"a key must be text{hint}")
            elif (earlier := first.setdefault(key, mark)) is not mark:
                where = f"line {earlier.line + 1}, column {earlier.column + 1}"
                self._report(key_node, f"{key}: duplicate key; it is already in {where}")
        self._loader.flatten_mapping(node)
        # Merged keys come first. Remove overridden ones, which are no duplicates for an alias of this node.
        node.value = list(
            {key.value: (key, value) for key, value in node.value if isinstance(key.value, str)}.values()
        )
        values = {}
        for key_node, value_node in node.value:
            place: Keys = (*keys, key_node.value)
            self._document.marks[place] = self.mark(key_node)
            values[key_node.value] = self.value(value_node, place)
        return values

    def _report(self, node: yaml.Node, message: str) -> None:
        self._document.report_at(self.mark(node), message)

    def mark(self, node: yaml.Node) -> Mark:
        """The location of a node."""
        return Mark(self._document.mark().file, node.start_mark.line + 1, node.start_mark.column + 1)
