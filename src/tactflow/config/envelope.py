"""Reads the engine's own values of a pipeline file: each is right, or reported and taken as not given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tactflow.config.registry import did_you_mean
from tactflow.config.yamlmap import Entry, Problems


def check_keys(entries: Mapping[str, Entry], known: Sequence[str], path: str, problems: Problems) -> None:
    """Report every key that is not known."""
    for key, entry in entries.items():
        if key not in known:
            problems.add(
                entry.mark, f"{path + '.' if path else ''}{key}: unknown key{did_you_mean(key, known)}"
            )


def choice(
    entries: Mapping[str, Entry], key: str, choices: Sequence[str], path: str, problems: Problems
) -> str | None:
    """The value of `key` if it is one of `choices`; None if it is not given or wrong."""
    entry = entries.get(key)
    if entry is None:
        return None
    value = entry.item.content
    if isinstance(value, str) and value in choices:
        return value
    hint = did_you_mean(value, choices) if isinstance(value, str) else ""
    hint = hint if "did you mean" in hint else ""
    expected = f"expected {' or '.join([', '.join(choices[:-1]), choices[-1]])}"
    problems.add(entry.item.mark, f"{path}.{key}: {expected}, got {entry.item.words()}{hint}")
    return None


def whole(entries: Mapping[str, Entry], key: str, least: int, path: str, problems: Problems) -> int | None:
    """The value of `key` if it is a whole number >= `least`; None if it is null, not given or wrong."""
    entry = entries.get(key)
    if entry is None or entry.item.content is None:
        return None
    value = entry.item.content
    if isinstance(value, int) and not isinstance(value, bool) and value >= least:
        return value
    expected = f"expected a whole number >= {least}"
    problems.add(entry.item.mark, f"{path + '.' if path else ''}{key}: {expected}, got {entry.item.words()}")
    return None


def word(entries: Mapping[str, Entry], key: str, path: str, problems: Problems) -> str | None:
    """The value of `key` if it is a word (see `is_word`); None if it is null, not given or wrong."""
    entry = entries.get(key)
    if entry is None or entry.item.content is None:
        return None
    value = entry.item.content
    if isinstance(value, str) and is_word(value):
        return value
    expected = "expected a word of letters, digits, _ and -"
    problems.add(entry.item.mark, f"{path + '.' if path else ''}{key}: {expected}, got {entry.item.words()}")
    return None


def is_word(text: str) -> bool:
    """True for a word of ASCII letters, digits, `_` and `-`."""
    return text.isascii() and text.replace("_", "a").replace("-", "a").isalnum()
