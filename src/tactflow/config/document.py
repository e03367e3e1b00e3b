"""A pipeline file as plain values with their locations; errors are shown with source line and caret."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
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

    Parameters
    ----------
    root : mappings, lists, text, numbers, booleans and None.
    file : its name in messages; or the origin of values outside a file, such as an option of the command
        line.
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
    if hint and b"\0" in data:
        raise ConfigError(f"{path} is not a pipeline file (YAML){hint}")
    # YAML does not allow the characters that bytes other than UTF-8 become.
    text = data.decode("utf-8-sig", "surrogateescape")
    document = Document(str(path), line=1)
    document.lines = text.splitlines()
    try:
        document.root, document.marks = _parse(text, str(path))
    except _InvalidYamlError as error:
        document.report_at(*error.args)
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
    try:
        return _parse(text, "")[0]
    except _InvalidYamlError as error:
        raise ConfigError(error.args[1]) from None


class _InvalidYamlError(Exception):
    """Arguments: the location and the message."""


def _parse(text: str, file: str) -> tuple[Any, dict[Keys, Mark]]:
    """The values of a YAML text, and the location of each."""
    line = column = 0
    try:
        loader = _Loader(text)
        root = loader.document()
        marks = {keys: Mark(file, at.line + 1, at.column + 1) for keys, at in loader.places.items()}
        return root, {(): Mark(file, 1, 1)} | marks
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n"), len(before) - before.rfind("\n") - 1
        message = f"the character #x{error.character:04x} is not allowed in YAML; save the file as UTF-8 text"
    except yaml.MarkedYAMLError as error:
        where = error.problem_mark or error.context_mark
        if where is not None:
            line, column = where.line, where.column
        message = _advice(error, [*text.splitlines(), ""][line][: column + 1])
    except RecursionError:
        message = "not a pipeline: values are nested too deeply"
    raise _InvalidYamlError(Mark(file, line + 1, column + 1), message)


def _advice(error: yaml.MarkedYAMLError, before: str) -> str:
    """PyYAML's message, with advice for common mistakes. before : the line up to the error."""
    if "\t" in before:
        return "a tab character; YAML is indented with blanks"
    around = ""
    if error.context and error.context_mark:
        around = f"{error.context} that starts in line {error.context_mark.line + 1}: "
    hint = "; text with ': ' in it needs quotes" if "mapping values are not" in str(error.problem) else ""
    return f"not valid YAML: {around}{error.problem}{hint}"


_TAG = "tag:yaml.org,2002:"
_SCALARS = frozenset(_TAG + name for name in ("null", "bool", "int", "float", "str"))


class _Loader(yaml.SafeLoader):
    """Loads plain values; dates stay text, and 1e-3 is a number as in YAML 1.2. Aliases are expanded.

    Attributes
    ----------
    places : path of a value -> location of its key, or of the item of a list.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.places: dict[Keys, yaml.Mark] = {}

    def document(self) -> Any:
        """The value of the text."""
        node = self.get_single_node()
        return None if node is None else self._value(node, (), node)

    def _value(self, node: yaml.Node, keys: Keys, key: yaml.Node) -> Any:
        self.places[keys] = key.start_mark
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            self._merge(node)
            return {key.value: self._value(value, (*keys, key.value), key) for key, value in node.value}
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self._value(part, (*keys, index), part) for index, part in enumerate(node.value)]
        with suppress(ValueError, LookupError):
            if isinstance(node, yaml.ScalarNode) and node.tag in _SCALARS:
                return self.construct_object(node)
        raise _invalid(node, f"{node.tag.replace(_TAG, '!!')} is not allowed here; write plain values")

    def _merge(self, node: yaml.MappingNode) -> None:
        """Check the keys of a mapping, and insert those of `<<`."""
        lines: dict[str, int] = {}
        for key, _ in node.value:
            if key.tag == _TAG + "str":
                line = key.start_mark.line + 1
                if key.value in lines:
                    raise _invalid(
                        key, f"{key.value}: duplicate key; it is already in line {lines[key.value]}"
                    )
                lines[key.value] = line
            elif key.tag != _TAG + "merge":
                hint = f"; put {key.value} in quotes" if isinstance(key, yaml.ScalarNode) else ""
                raise _invalid(key, f"a key must be text{hint}")
        self.flatten_mapping(node)
        # Merged keys come first. Remove overridden ones, which are no duplicates for an alias of this node.
        node.value = list({key.value: (key, value) for key, value in node.value}.values())


_Loader.yaml_implicit_resolvers = {
    first: [(tag, regexp) for tag, regexp in resolvers if not tag.endswith((":timestamp", ":value"))]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    _TAG + "float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def _invalid(node: yaml.Node, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
