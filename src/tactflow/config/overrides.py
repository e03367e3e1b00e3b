"""Overrides of a pipeline file: `--set a.b.c=VALUE`, settings in Python, sinks of options."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic_core import to_jsonable_python

from tactflow.config.document import Document, Keys, parse_value
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Mark, Node
from tactflow.system.redaction import public_setting
from tactflow.system.spelling import did_you_mean


@dataclass(frozen=True, slots=True)
class Override:
    """A replacement for a value.

    Attributes
    ----------
    key : dotted path, as in "stages.hull.min_area".
    value : a Python object; None for a whole stage or sink removes it.
    origin : stands for file, line and column in messages.
    """

    key: str
    value: Any
    origin: str


def from_settings(settings: Mapping[str, Any]) -> list[Override]:
    """Overrides from `{"stages.hull.min_area": 50}` or `{"stages": {"hull": {"min_area": 50}}}`.

    Settings of stages and of the gel are merged with those of the file; other values are replaced.

    >>> from_settings({"sinks.zmq": None})
    [Override(key='sinks.zmq', value=None, origin='settings')]
    >>> [override.key for override in from_settings({"stages": {"hull": {"min_area": 50}}})]
    ['stages.hull.min_area']
    """
    flat = dict(settings)
    for key in ("gel", "stages", *(f"stages.{id_}" for id_ in _part(settings, "stages"))):
        if part := _part(flat, key):
            del flat[key]
            flat |= {f"{key}.{name}": value for name, value in part.items()}
    return [Override(key, value, "settings") for key, value in flat.items()]


def _part(settings: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = settings.get(key)
    return value if isinstance(value, Mapping) else {}


def as_yaml(value: Any) -> str:
    """A value for `--set`, as JSON, which is also YAML."""
    return json.dumps(plain(value), ensure_ascii=False)


def added(node: Node) -> str:
    """The argument of `--set` that adds the same sink as an option of the command line did."""
    settings = node.params.model_dump(mode="json", by_alias=True, exclude_unset=True)
    return f"sinks.{node.id}={as_yaml({'use': node.component.name} | settings)}"


def plain(value: Any) -> Any:
    """Convert a Python value to mappings, lists, text, numbers, booleans and None.

    Raises
    ------
    ConfigError : a text, such as a file name, that is not UTF-8.

    >>> import numpy as np
    >>> plain({"size": (1, np.float32(0.5))})
    {'size': [1, 0.5]}
    """
    result = to_jsonable_python(value, fallback=lambda part: getattr(part, "tolist", part.__str__)())
    try:
        json.dumps(result, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{value!r} is not UTF-8; rename the file") from None
    return result


def apply(document: Document, override: Override | str, base: Keys = ()) -> None:
    """Apply an override, or an argument of `--set`, to the document, which records errors.

    base : path to which its key is relative.
    """
    if isinstance(override, str):
        origin, (key, _, text) = f"--set {public_setting(override)}", override.partition("=")
    else:
        origin, key, text = override.origin, override.key, ""
    mark, keys = Mark(origin, 0, 0), [part.strip() for part in key.split(".")]
    try:
        if not all(keys) or override == key:
            raise ConfigError(f"expected a.b.c=VALUE, as in stages.hull.min_area=50, got {key!r}")
        value = parse_value(text) if isinstance(override, str) else plain(override.value)
        entries = document.mapping(keys[0]) if len(keys) == 2 and keys[0] in ("stages", "sinks") else None
        if value is not None or entries is None:
            document.set((*base, *keys), value, mark)
        elif keys[1] in entries:
            del entries[keys[1]]
        else:
            hint = did_you_mean(keys[1], entries)
            raise ConfigError(f"there is no {keys[0][:-1]} {keys[1]!r} to remove{hint}")
    except ConfigError as error:
        for mistake in error.mistakes:
            document.report_at(mark, mistake)


def add_sinks(document: Document, extra: Mapping[str, Mapping[str, Any]]) -> None:
    """Add the sinks of options such as `--jsonl`, with unused ids."""
    for option, settings in extra.items():
        use = id_ = option.lstrip("-")
        taken = {*document.mapping("stages"), *document.mapping("sinks")}
        count = 2
        while id_ in taken:
            id_ = f"{use}_{count}"
            count += 1
        document.set(("sinks", id_), plain({"use": use} | dict(settings)), Mark(f"--{use}", 0, 0))
