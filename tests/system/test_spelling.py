"""A suggestion where a word is misspelled, a list of what there is where it is another word."""

from __future__ import annotations

import pytest

from tactflow.config.registry import resolve
from tactflow.system.spelling import closest, did_you_mean


def test_a_misspelled_word_gets_a_suggestion_and_another_one_the_list() -> None:
    assert closest("HULL", ["hull"]) == "hull"
    assert did_you_mean("hul", ["hull", "capture"]) == "; did you mean hull?"
    assert did_you_mean("zzz", ["hull", "capture"]) == "; known: hull, capture"
    assert did_you_mean("zzz", []) == ""


@pytest.mark.parametrize(
    ("use", "word", "meant"),
    [
        ("hull", "min_aera", "min_area"),
        ("visualize", "threads", None),
        ("hold", "threshold", None),
        ("tracker", "port", None),
    ],
)
def test_only_a_wrong_letter_or_two_are_taken_for_a_parameter(use: str, word: str, meant: str | None) -> None:
    assert closest(word, resolve(use, "stages").params.model_fields) == meant
