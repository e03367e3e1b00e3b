"""`sensors:` in a pipeline file: the same graph for several sensors, with changes for each.

    sensors:
      left:  {stages: {capture: {source: /dev/video0}}}
      right: {stages: {capture: {source: /dev/video2}, preprocess: {rotate: 270}}}

The changes of a sensor are merged into the rest of the file; null removes a stage, a sink or a parameter.
`{sensor}` in any text of a sink is replaced by the sensor's name.
"""

from __future__ import annotations

import os
from typing import Any

from tactflow.config.document import Document, Keys
from tactflow.config.models import Changes, is_word
from tactflow.system.files import STREAMS, is_device
from tactflow.system.spelling import did_you_mean

PLACEHOLDER = "{sensor}"


def names(document: Document) -> list[str]:
    """The names under `sensors:`, in order; empty without that key."""
    return list(document.mapping("sensors"))


def select(document: Document, chosen: str | None) -> str:
    """Reduce the document to one sensor; returns the sensor's name.

    chosen : a name under `sensors:`; None for the first one, or for the only one of a file without that key.
    """
    known = names(document)
    if not document.has("sensors"):
        name = document.get("sensor")
        name = name if isinstance(name, str) and is_word(name) else "main"
        if chosen not in (None, name):
            document.report((), f"there is no sensor {chosen!r}; the file's only sensor is {name}")
    else:
        if document.has("sensor"):
            mark = document.mark("sensors")
            document.report(("sensor",), f"the sensors are named under sensors ({mark}); remove this key")
        if chosen is not None and chosen not in known:
            hint = did_you_mean(chosen, known)
            document.report(("sensors",), f"there is no {chosen!r}{hint}")
        name = chosen if chosen in known else known[0] if known else "main"
        for key in document.mapping("sensors", name):
            if key in Changes.model_fields:
                _merge(document, ("sensors", name, key), (key,))
    if document.mapping("sinks"):
        document.root["sinks"] = _filled_in(document.root["sinks"], name)
    return name


def with_name(path: str, sensor: str) -> str:
    """The file that one of several sensors writes, given the `path` on the command line.

    Standard output and devices are shared by all.

    >>> with_name("out.jsonl", "left"), with_name("{sensor}/out.jsonl", "left")
    ('out-left.jsonl', 'left/out.jsonl')
    """
    if path in STREAMS or is_device(path):
        return path
    name, suffix = os.path.splitext(path)
    return path.replace(PLACEHOLDER, sensor) if PLACEHOLDER in path else f"{name}-{sensor}{suffix}"


def _merge(document: Document, change: Keys, target: Keys) -> None:
    """Replace a value of the file by one of `sensors:`; mappings are merged."""
    value, mark = document.get(*change), document.mark(*change)
    if isinstance(value, dict):
        if not isinstance(document.get(*target), dict):
            document.set(target, {}, mark)
        for key in value:
            _merge(document, (*change, key), (*target, key))
    elif value is None and len(target) > 1 and document.has(*target):
        del document.mapping(*target[:-1])[str(target[-1])]
    else:
        document.set(target, value, mark)


def _filled_in(value: Any, name: str) -> Any:
    if isinstance(value, str):
        return value.replace(PLACEHOLDER, name)
    if isinstance(value, list):
        return [_filled_in(part, name) for part in value]
    if isinstance(value, dict):
        return {key: _filled_in(part, name) for key, part in value.items()}
    return value
