"""Changes to a pipeline file from outside it: `--set a.b.c=VALUE`, settings in Python, sinks of options."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactflow.config.yamlmap import Entry, Item, Problems, read_value, wrap
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Mark
from tactflow.system.redaction import public_setting
from tactflow.system.spelling import did_you_mean


@dataclass(frozen=True, slots=True)
class Override:
    """One value that replaces another.

    key : dotted path, as in "stages.hull.min_area". value : a Python object; None for a whole stage or sink
    removes it. origin : what a message about the value begins with, in place of file, line and column.
    """

    key: str
    value: Any
    origin: str


def from_settings(settings: Mapping[str, Any]) -> list[Override]:
    """Overrides from a program's `{"stages.hull.min_area": 50}`.

    >>> from_settings({"sinks.zmq": None})
    [Override(key='sinks.zmq', value=None, origin='settings')]
    """
    return [Override(key, value, "settings") for key, value in settings.items()]


def as_yaml(value: Any) -> str:
    """A value as `--set` takes it: JSON, which is YAML too. Numbers and arrays of NumPy are plain ones.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> as_yaml({"path": Path("out/a.jsonl"), "rate": np.float32(0.5), "size": np.arange(2)})
    '{"path": "out/a.jsonl", "rate": 0.5, "size": [0, 1]}'
    """
    return json.dumps(plain(value), ensure_ascii=False)


def plain(value: Any) -> Any:
    """A Python value as YAML would hold it: mappings, lists, text, numbers, booleans and None.

    >>> plain({"size": (1, np.float32(0.5))})
    {'size': [1, 0.5]}
    """
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value if isinstance(value, str | int | float | None) else str(value)


def apply(root: Item, override: Override | str, problems: Problems) -> Item:
    """The document with one override, or the text of a `--set`, in it."""
    if isinstance(override, str):
        mark = Mark(f"--set {public_setting(override)}", 0, 0)
        path, equals, text = override.partition("=")
        value = read_value(text, mark, problems) if equals else None
        if equals and value is None:
            return root
    else:
        mark, path = Mark(override.origin, 0, 0), override.key
        value = wrap(plain(override.value), mark)
    keys = [key.strip() for key in path.split(".")]
    if value is None or not all(keys):
        expected = "a.b.c=VALUE, as in stages.hull.min_area=50"
        if not isinstance(override, str):
            expected = f"a key such as stages.hull.min_area, got {path!r}"
        problems.add(mark, f"expected {expected}")
        return root
    try:
        if value.content is None and len(keys) == 2 and keys[0] in ("stages", "sinks"):
            return _removed(root, keys[0], keys[1])
        return replaced(root, keys, value, mark)
    except ConfigError as error:
        problems.add(mark, str(error))
        return root


def add_sinks(root: Item, extra: Mapping[str, Mapping[str, Any]]) -> Item:
    """The document with the sinks that options such as `--jsonl` add; each gets an id that is free."""
    for option, settings in extra.items():
        use = id_ = option.lstrip("-")
        mark = Mark(f"--{use}", 0, 0)
        sections = (root.entries.get(section) for section in ("stages", "sinks"))
        taken = {key for section in sections if section for key in section.item.entries}
        count = 2
        while id_ in taken:
            id_ = f"{use}_{count}"
            count += 1
        root = replaced(root, ["sinks", id_], wrap({"use": use} | dict(settings), mark), mark)
    return root


def replaced(item: Item | None, keys: Sequence[str], value: Item, mark: Mark, path: str = "") -> Item:
    """A copy of `item` in which one value is replaced; parts that an alias shares stay as they are.

    Raises
    ------
    ConfigError : the keys lead through a value that has no parts.
    """
    if not keys:
        return value
    key, rest = keys[0], keys[1:]
    inner = f"{path}.{key}" if path else key
    if item is not None and isinstance(item.content, list):
        if not key.isdecimal() or int(key) >= len(item.content):
            raise ConfigError(f"{path} is a list with {len(item.content)} items, counted from 0")
        parts = list(item.content)
        parts[int(key)] = replaced(parts[int(key)], rest, value, mark, inner)
        return Item(parts, item.mark)
    if item is not None and not item.is_mapping:
        raise ConfigError(f"{path} is {item.words()}, so it has no {key}")
    entries = dict(item.entries) if item else {}
    old = entries.get(key)
    part = replaced(old.item if old else None, rest, value, mark, inner)
    entries[key] = Entry(old.mark if old else mark, part)
    return Item(entries, item.mark if item else mark)


def _removed(root: Item, section: str, id_: str) -> Item:
    held = root.entries.get(section)
    entries = dict(held.item.entries) if held else {}
    if held is None or id_ not in entries:
        raise ConfigError(f"there is no {section[:-1]} {id_!r} to remove{did_you_mean(id_, entries)}")
    del entries[id_]
    return Item(root.entries | {section: Entry(held.mark, Item(entries, held.item.mark))}, root.mark)
