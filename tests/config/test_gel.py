"""Properties under `gel:` reach every stage that has a parameter of the name and does not set it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import Override, from_settings
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

FILE = """\
gel: {repeatability: 0.05, polarity: dark, dot: 4}
stages:
  capture:
  probe:
  preprocess:
  marker_mask: {dot: auto}
  inpaint:
  difference: {tint: 0.02}
  tracker:
  narrow: {use: './narrow.py:Narrow'}
sinks:
  jsonl: {path: '-'}
"""
NARROW = """\
from pydantic import Field
from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import Image

class Narrow(Stage):
    memory = "pure"
    class Params(StageParams):
        dot: float = Field(2, le=5)
    def process(self, image: Image) -> Image:
        return image
"""

Load = Callable[..., Pipeline]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """Load a pipeline text."""
    (tmp_path / "narrow.py").write_text(NARROW)

    def from_text(text: str, *overrides: Override | str, **options: str) -> Pipeline:
        (tmp_path / "p.yaml").write_text(text)
        return load_pipeline(tmp_path / "p.yaml", overrides, **options)

    return from_text


def given(pipeline: Pipeline, name: str) -> dict[str, object]:
    """Stage -> its value of a parameter."""
    nodes = pipeline.nodes.items()
    return {id_: getattr(node.params, name) for id_, node in nodes if hasattr(node.params, name)}


def test_stages_take_the_value_of_the_gel_and_their_own_wins(load: Load) -> None:
    pipeline = load(FILE)
    assert given(pipeline, "repeatability") == {"probe": 0.05, "difference": 0.05}
    assert given(pipeline, "polarity") == {"marker_mask": "dark", "tracker": "dark"}
    assert given(pipeline, "tint") == {"probe": 0.01, "difference": 0.02}
    assert given(pipeline, "dot") == {"marker_mask": "auto", "tracker": 4, "narrow": 4}


def test_a_file_without_the_section_and_one_that_is_empty_have_the_defaults(load: Load) -> None:
    without = FILE.partition("\n")[2]
    for text in (without, "gel:\n" + without, "gel: {repeatability: null}\n" + without):
        assert given(load(text), "repeatability") == {"probe": 0.025, "difference": 0.025}


def test_options_settings_and_sensors_change_the_section(load: Load) -> None:
    assert given(load(FILE, "gel.repeatability=0.1"), "repeatability") == {"probe": 0.1, "difference": 0.1}
    settings = from_settings({"gel": {"tint": 0.5}})
    changed = load(FILE, *settings)
    assert given(changed, "tint") == {"probe": 0.5, "difference": 0.02}
    assert given(changed, "repeatability") == {"probe": 0.05, "difference": 0.05}
    several = "sensors: {left: {gel: {repeatability: 0.2, dot: null}}}\n" + FILE
    left = load(several, sensor="left")
    assert given(left, "repeatability") == {"probe": 0.2, "difference": 0.2}
    assert given(left, "dot") == {"marker_mask": "auto", "tracker": None, "narrow": 2}


def test_the_settings_of_a_run_hold_the_section_once(load: Load) -> None:
    settings = load(FILE).settings
    assert settings["gel"] == {"repeatability": 0.05, "polarity": "dark", "dot": 4}
    assert settings["stages"]["difference"] == {"tint": 0.02}


@pytest.mark.parametrize(
    ("line", "column", "words"),
    [
        ("gel: {tnt: 0.1}", 7, "gel.tnt: unknown key; did you mean tint?"),
        ("gel: {repeatability: 2}", 7, "gel.repeatability: should be less than or equal to 1, got 2"),
        (
            "gel: {polarity: drak}",
            7,
            "gel.polarity: should be 'auto', 'dark' or 'bright', got 'drak'",
        ),
        ("gel: {tint: 0.1, dot: 6}", 18, "gel.dot: should be less than or equal to 5, got 6"),
        ("gel: rubber", 1, "gel: should be a mapping, got 'rubber'"),
    ],
)
def test_a_mistake_is_reported_once_at_its_place(line: str, column: int, words: str, load: Load) -> None:
    with pytest.raises(ConfigError) as caught:
        load(line + "\n" + FILE.partition("\n")[2])
    (mistake,) = caught.value.mistakes
    assert f"p.yaml:1:{column}  {words}" in mistake


@pytest.mark.parametrize("name", ["default", "markerless", "tactip"])
def test_the_shipped_pipelines_say_what_the_gel_is_like_in_one_place(name: str) -> None:
    pipeline = load_pipeline(find_pipeline(name), ["gel.repeatability=0.3"])
    assert set(given(pipeline, "repeatability").values()) == {0.3}
    assert not any(
        {"repeatability", "tint", "polarity"} & set(s or ()) for s in pipeline.settings["stages"].values()
    )
