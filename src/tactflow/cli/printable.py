"""Text from elsewhere on a terminal."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    """Text from files, cameras and the network without what would command the terminal.

    >>> printable("left\\x1b[2J, no\\ttab")
    'left?[2J, no\\ttab'
    """
    return _CONTROL.sub("?", text)


def typed(*words: str) -> str:
    """Words of a command line as they are typed, so that blanks and `?` in names reach the program.

    >>> typed("tactflow", "run", "left.yaml")
    'tactflow run left.yaml'
    """
    return subprocess.list2cmdline(words) if sys.platform == "win32" else shlex.join(words)
