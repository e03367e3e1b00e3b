"""A suggestion where a word is misspelled, a list of what there is where it is another word."""

from __future__ import annotations

import pytest

from tactflow.config.registry import available, resolve
from tactflow.sim.settings import Settings
from tactflow.system.spelling import closest, did_you_mean


def test_a_misspelled_word_gets_a_suggestion_and_another_one_the_list() -> None:
    assert closest("HULL", ["hull"]) == "hull"
    assert did_you_mean("hul", ["hull", "capture"]) == "; did you mean hull?"
    assert did_you_mean("zzz", ["hull", "capture"]) == "; known: hull, capture"
    assert did_you_mean("zzz", []) == ""


@pytest.mark.parametrize(
    ("word", "meant"),
    [("min_aera", "min_area"), ("hlod", "hold"), ("pach", "path"), ("angel", "angle"), ("sink", "sinks")],
)
def test_one_wrong_letter_of_four_and_two_in_the_wrong_order_are_seen(word: str, meant: str) -> None:
    names = [name for part in available() for name in part.params.model_fields]
    assert closest(word, [*names, "sinks", "angle"]) == meant


@pytest.mark.parametrize(
    ("use", "section", "word"),
    [
        ("inpaint", "stages", "threads"),
        ("hold", "stages", "threshold"),
        ("jsonl", "sinks", "depth"),
        ("tracker", "stages", "port"),
    ],
)
def test_another_word_is_not_taken_for_a_parameter(use: str, section: str, word: str) -> None:
    assert closest(word, resolve(use, section).params.model_fields) is None  # type: ignore[arg-type]


def test_another_word_is_not_taken_for_a_key_of_a_simulated_scene() -> None:
    for word in ("kind", "help", "force", "image", "threads", "camera", "method"):
        assert closest(word, Settings.model_fields) is None
