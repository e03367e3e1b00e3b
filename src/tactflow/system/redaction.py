"""Removes passwords and tokens from logs, error messages and recordings."""

from __future__ import annotations

import re
from typing import Any

# A single slash is the result of passing an address through `pathlib`.
_ADDRESS = re.compile(r"\b((?!ipc:|file:)[A-Za-z][A-Za-z0-9+.-]*://|(?:https?|rtsps?|udp|tcp):/)(\S*)")
_KEYS = ("token", "password")
"""Parameters of stages and sinks whose values are secret."""
_SETTING = re.compile(rf"\b({'|'.join(_KEYS)})(\s*[=:]\s*)[^\s,}}]+")


def public_address(text: str) -> str:
    """Reduce addresses to scheme and host, because user, path and query may contain a password.

    >>> public_address("rtsp://me:p@ss@camera:554/1?channel=2&pwd=1234: no stream")
    'rtsp://camera:554/...: no stream'
    """
    return _ADDRESS.sub(_scheme_and_host, text)


def _scheme_and_host(address: re.Match[str]) -> str:
    scheme, rest = address[1], address[2].rstrip("]:;,.'\")}>")
    punctuation = address[2][len(rest) :]  # of the sentence or the YAML around the address
    authority = re.split(r"[/?#;]", rest, maxsplit=1)[0]
    host = authority.rpartition("@")[2]
    if rest in (host, f"{host}/"):
        # Nothing to hide, or hidden already.
        return address[0]
    if "@" in rest[len(authority) :]:
        # A password may contain a slash, so that the text before it need not be the host.
        return f"{scheme}...{punctuation}"
    return f"{scheme}{host}/...{punctuation}"


def public_setting(text: str) -> str:
    """The argument of `--set` without secrets.

    >>> public_setting("sinks.view={token: abc, port: 80}"), public_setting("sinks.view.token=abc")
    ('sinks.view={token: removed, port: 80}', 'sinks.view.token=removed')
    """
    return public_address(_SETTING.sub(r"\1\2removed", text))


def without_secrets(settings: Any) -> Any:
    """Settings of a pipeline without passwords in addresses and without tokens, for sharing.

    >>> without_secrets({"source": "rtsp://me:pass@camera/1", "token": "abc", "host": None})
    {'source': 'rtsp://camera/...', 'token': 'removed', 'host': None}
    """
    if isinstance(settings, dict):
        return {
            key: "removed" if key in _KEYS and part not in (None, "") else without_secrets(part)
            for key, part in settings.items()
        }
    if isinstance(settings, list):
        return [without_secrets(part) for part in settings]
    return public_address(settings) if isinstance(settings, str) else settings
