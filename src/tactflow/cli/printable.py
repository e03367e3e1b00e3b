"""Text from elsewhere on a terminal."""

from __future__ import annotations

import re

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    """Text from files, cameras and the network without what would command the terminal.

    >>> printable("left\\x1b[2J, no\\ttab")
    'left?[2J, no\\ttab'
    """
    return _CONTROL.sub("?", text)
