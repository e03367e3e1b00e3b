"""Text for people on a terminal."""

from __future__ import annotations

import re

from tactflow.redaction import public_address

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    """Text without what would command the terminal, and without passwords in addresses.

    >>> printable("left\\x1b[2J, no\\ttab"), printable("rtsp://me:pass@camera/1: no stream")
    ('left?[2J, no\\ttab', 'rtsp://camera/1: no stream')
    """
    return public_address(_CONTROL.sub("?", text))
