"""Types of command-line arguments: numbers within limits, lengths of time."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable

UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}
"""Unit -> seconds."""


def number(kind: type[float], least: float, most: float, required: str) -> Callable[[str], float]:
    """A type of argparse: an `int` or `float` within limits. required : what the complaint asks for.

    >>> number(float, 0.1, 100.0, "a length")("1e300")
    Traceback (most recent call last):
    argparse.ArgumentTypeError: required a length, got '1e300'
    """

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"required {required}, got {text!r}")
        return value

    return parse


positive = number(int, 1, math.inf, "a whole number from 1")


def seconds(text: str) -> float:
    """A type of argparse: a length of time above 0, s.

    >>> seconds("90s"), seconds("1.5min"), seconds("1h")
    (90.0, 90.0, 3600.0)
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z]*)", text.strip())
    if match is None or match[2] not in UNITS or float(match[1]) <= 0:
        raise argparse.ArgumentTypeError(f"required a time such as 90s, 2min or 1h, got {text!r}")
    return float(match[1]) * UNITS[match[2]]
