"""Numbers and times of the command line."""

from __future__ import annotations

from argparse import ArgumentTypeError
from collections.abc import Callable

import pytest

from tactflow.cli.options import number, positive, seconds

LENGTH = number(float, 0.1, 100.0, "a length")


@pytest.mark.parametrize(
    ("parse", "words", "required"),
    [
        (positive, ["0", "-5", "1e5", "many", ""], "a whole number from 1"),
        (seconds, ["0", "-5", "nan", "inf", "2 days", ""], "a time such as 90s"),
        (LENGTH, ["0", "101", "nan", "inf", "-inf", "1e300", "1 mm", ""], "a length"),
    ],
)
def test_invalid_values_are_refused(parse: Callable[[str], float], words: list[str], required: str) -> None:
    for word in words:
        with pytest.raises(ArgumentTypeError, match=f"required {required}.*got {word!r}"):
            parse(word)


@pytest.mark.parametrize(
    ("parse", "word", "value"),
    [
        (positive, "100000", 100_000),
        (LENGTH, "0.1", 0.1),
        (seconds, "0.05", 0.05),
        (seconds, "90s", 90.0),
        (seconds, "2min", 120.0),
        (seconds, "1h", 3600.0),
    ],
)
def test_valid_values_are_read(parse: Callable[[str], float], word: str, value: float) -> None:
    assert parse(word) == value
