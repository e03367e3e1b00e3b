"""Removes passwords and tokens from logs, error messages and recordings."""

from __future__ import annotations

import re
from collections.abc import Iterator
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


def without_secrets(text: str) -> str:
    """The text of a pipeline without passwords in addresses and without tokens, for sharing.

    >>> print(without_secrets("{source: rtsp://me:pass@camera/1, token: abc, host: null}"))
    {source: rtsp://camera/..., token: removed, host: null}
    """
    # Imported here, because it is slow and rarely needed.
    import yaml

    try:
        document = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError):
        return ""
    # In any notation: quoted, on its own line, by an alias.
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
