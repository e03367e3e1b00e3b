"""Numbers and times of the command line."""

from __future__ import annotations

from argparse import ArgumentTypeError

import pytest

from tactflow.cli.options import positive, seconds


@pytest.mark.parametrize("word", ["0", "-5", "1e5", "many", ""])
def test_a_count_that_is_none_is_refused(word: str) -> None:
    with pytest.raises(ArgumentTypeError, match="required a whole number from 1"):
        positive(word)


def test_a_count_is_read() -> None:
    assert positive("100000") == 100_000


@pytest.mark.parametrize("word", ["0", "-5", "nan", "inf", "2 days", ""])
def test_a_time_that_is_none_is_refused(word: str) -> None:
    with pytest.raises(ArgumentTypeError, match="required a time such as 90s"):
        seconds(word)


@pytest.mark.parametrize(("word", "time"), [("0.05", 0.05), ("90s", 90.0), ("2min", 120.0), ("1h", 3600.0)])
def test_a_time_is_read_in_its_unit(word: str, time: float) -> None:
    assert seconds(word) == time
