"""What the command line changes of a pipeline file: `--set a.b.c=VALUE`, and sinks that options add."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tactflow.config.yamlmap import Entry, Item, Problems, read_value, wrap
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Mark
from tactflow.system.redaction import public_setting
from tactflow.system.spelling import did_you_mean


def as_yaml(value: Any) -> str:
    """A value as `--set` takes it: JSON, which is YAML too. Numbers and arrays of NumPy are plain ones.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> as_yaml({"path": Path("out/a.jsonl"), "rate": np.float32(0.5), "size": np.arange(2)})
    '{"path": "out/a.jsonl", "rate": 0.5, "size": [0, 1]}'
    """
    return json.dumps(value, ensure_ascii=False, default=_plain)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else str(value)


def apply(root: Item, text: str, problems: Problems) -> Item:
    """The document with one `--set` in it.

    text : `a.b.c=VALUE`, with VALUE in YAML; null for a whole stage or sink removes it.
    """
    mark = Mark(f"--set {public_setting(text)}", 0, 0)
    path, equals, value_text = text.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        problems.add(mark, "expected a.b.c=VALUE, as in stages.hull.min_area=50")
        return root
    value = read_value(value_text, mark, problems)
    if value is None:
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
