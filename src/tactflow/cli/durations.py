"""Lengths of time on the command line."""

from __future__ import annotations

import argparse
import re

UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}
"""Unit -> seconds."""


def seconds(text: str) -> float:
    """A length of time above 0, s.

    Raises
    ------
    argparse.ArgumentTypeError
        If the text is none.

    >>> seconds("90s"), seconds("1.5min")
    (90.0, 90.0)
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z]*)", text.strip())
    if match is None or match[2] not in UNITS or float(match[1]) <= 0:
        raise argparse.ArgumentTypeError(f"required a time such as 90s, 2min or 1h, got {text!r}")
    return float(match[1]) * UNITS[match[2]]
