"""Suggestions for misspelled words, lists of words, and comparisons of numbers, in messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import Final

MIN_SIMILARITY: Final = 0.75
"""Minimum similarity (`difflib`, 0 to 1) of a misspelled word: one wrong letter of four, or two in the wrong
order. Different words are less similar: threads and radius 0.62, depth and path 0.67."""


def closest(word: str, candidates: Iterable[str]) -> str | None:
    """The candidate that a word is most likely a misspelling of, or None; case-insensitive.

    >>> closest("min_aera", ["min_area", "method"]), closest("HULL", ["hull"]), closest("threads", ["radius"])
    ('min_area', 'hull', None)
    """
    lowered = {candidate.lower(): candidate for candidate in candidates}
    matches = difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=MIN_SIMILARITY)
    return lowered[matches[0]] if matches else None


def did_you_mean(word: str, candidates: Iterable[str], otherwise: str = "known: ") -> str:
    """`; did you mean X?` for a misspelled word, else the list of candidates, if any.

    otherwise : beginning of the list.

    >>> did_you_mean("hul", ["hull", "capture"]), did_you_mean("zzz", ["hull", "capture"])
    ('; did you mean hull?', '; known: hull, capture')
    """
    candidates = list(candidates)
    guess = closest(word, candidates)
    if guess is not None:
        return f"; did you mean {guess}?"
    return f"; {otherwise}{', '.join(candidates)}" if candidates else ""


def joined(words: Sequence[str]) -> str:
    """Words as a list in a sentence.

    >>> joined(["mcap"]), joined(["mcap", "av"]), joined(["mcap", "av", "zarr"])
    ('mcap', 'mcap and av', 'mcap, av and zarr')
    """
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def distinct(value: float, limit: float) -> tuple[str, str]:
    """Two different numbers, with as many decimals as it takes to tell them apart; six at most.

    >>> distinct(31.2, 22.0), distinct(22.04, 22.0)
    (('31', '22'), ('22.04', '22.00'))
    """
    texts = ((f"{value:.{decimals}f}", f"{limit:.{decimals}f}") for decimals in range(7))
    first, second = next((pair for pair in texts if pair[0] != pair[1]), (f"{value:.6f}", f"{limit:.6f}"))
    return first, second
