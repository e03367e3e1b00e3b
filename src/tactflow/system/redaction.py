"""Removes passwords and tokens from logs, error messages and recordings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import yaml

# Up to the last @, since a password may have one in it, and quotes too.
_USER = re.compile(r"(?<=//)[^/\s]*@")
_IN_QUERY = re.compile(
    r"([?&][\w.-]*(?:user|usr|login|pass|pwd|token|auth|key|secret)[\w.-]*=)[^&\s'\"]+", re.IGNORECASE
)
_KEYS = ("token", "password")
"""Parameters of stages and sinks whose values are secret."""
_SETTING = re.compile(rf"\b({'|'.join(_KEYS)})(\s*[=:]\s*)[^\s,}}]+")


def public_address(text: str) -> str:
    """Addresses without user names and passwords.

    >>> public_address("rtsp://me:p@ss@camera/1?channel=2&pwd=1234")
    'rtsp://camera/1?channel=2&pwd=removed'
    """
    return _IN_QUERY.sub(r"\1removed", _USER.sub("", text))


def public_setting(text: str) -> str:
    """The argument of `--set` without secrets.

    >>> public_setting("sinks.view={token: abc, port: 80}"), public_setting("sinks.view.token=abc")
    ('sinks.view={token: removed, port: 80}', 'sinks.view.token=removed')
    """
    return public_address(_SETTING.sub(r"\1\2removed", text))


def without_secrets(text: str) -> str:
    """The text of a pipeline without passwords in addresses and without tokens, for files that are shared.

    >>> print(without_secrets("{source: rtsp://me:pass@camera/1, token: abc, host: null}"))
    {source: rtsp://camera/1, token: removed, host: null}
    """
    try:
        document = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError):
        return ""
    # However it is written: in quotes, on a line of its own, by an alias.
    for secret in sorted(set(_secrets(document)), key=len, reverse=True):
        text = text.replace(secret, "removed")
    return public_address(text)


def _secrets(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, part in value.items():
            # `stages.view.token: ...` is how a sensor overrides one value.
            if str(key).rpartition(".")[2] in _KEYS and part not in (None, ""):
                yield str(part)
            else:
                yield from _secrets(part)
    elif isinstance(value, list):
        for part in value:
            yield from _secrets(part)
