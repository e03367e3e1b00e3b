"""Types of command-line arguments: numbers within limits."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


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
seconds = number(float, 0.001, 1e6, "a number of seconds, such as 2.5")
