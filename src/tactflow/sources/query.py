"""Settings behind a path: `bag.mcap?topic=/camera/image`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from urllib.parse import parse_qsl

from tactflow.engine.errors import SourceError
from tactflow.system.files import expanded


def split_query(spec: str, directory: Path | None, known: Mapping[str, str]) -> tuple[str, dict[str, str]]:
    """The path and the settings of a source.

    Parameters
    ----------
    spec : `path`, or `path?name=value&name=value`; `%26` stands for &. A file whose name has a ? in it comes
        first.
    directory : where a relative path is looked for if it is not in the current directory.
    known : name -> what it is, for messages.

    Raises
    ------
    SourceError
        If a setting is not known, or comes twice.

    >>> split_query("bag.mcap?topic=/gel/image", None, {"topic": "name of a topic"})
    ('bag.mcap', {'topic': '/gel/image'})
    """
    name, mark, query = spec.partition("?")
    if not mark or any((base / expanded(spec)).exists() for base in (Path(), directory or Path())):
        return spec, {}
    settings: dict[str, str] = {}
    for key, value in parse_qsl(query.replace("+", "%2B"), keep_blank_values=True):
        if key not in known or key in settings or not value:
            raise SourceError(f"{spec}: {key}={value}: required {in_words(known)}")
        settings[key] = value
    return name, settings


def in_words(known: Mapping[str, str]) -> str:
    """The settings that there are, as `name=what it is`."""
    return ", ".join(f"{setting}={what}" for setting, what in known.items())
