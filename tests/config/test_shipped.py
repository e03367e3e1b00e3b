"""The pipelines that come with tactflow, and how they are found."""

from __future__ import annotations

from pathlib import Path

import pytest

import tactflow
from tactflow.config.shipped import described_pipelines, find_pipeline, packaged_pipelines
from tactflow.engine.errors import ConfigError

PLAIN = ("9dtact", "digit", "markerless", "mini_plain")


@pytest.mark.parametrize("name", packaged_pipelines())
def test_a_shipped_pipeline_has_no_mistakes_and_says_what_it_is_for(name: str) -> None:
    assert tactflow.check(name) == []
    assert 10 < len(described_pipelines()[name]) < 90


@pytest.mark.parametrize("name", sorted({*packaged_pipelines()} - {"classic"}))
def test_a_shipped_pipeline_publishes_writes_and_shows_its_results_as_the_readme_says(name: str) -> None:
    sinks = {id_: node for id_, node in tactflow.load(name).nodes.items() if node.component.kind == "sink"}
    values = {id_: node.params.model_dump() for id_, node in sinks.items()}
    assert list(values) == ["zmq", "jsonl", "view"]
    assert values["zmq"]["endpoint"] == "tcp://127.0.0.1:5556"
    assert values["jsonl"]["path"] == "out/results.jsonl"
    assert values["view"]["port"] == 8780


@pytest.mark.parametrize("name", sorted({*packaged_pipelines()} - {"default", "classic", "wedge"}))
def test_a_shipped_pipeline_sees_a_simulated_press(name: str) -> None:
    scene = "unmarked" if name in PLAIN else "bright_dots" if name == "tactip" else "press"
    settings = {"stages.preprocess.downsample": 2, "stages.preprocess.rotate": 90}
    found = list(tactflow.stream(name, source=f"sim:{scene}?frames=44", settings=settings))
    assert found[0].contact is None
    assert any(result.contact is not None for result in found)
    assert (found[-1].markers is None) == (name in PLAIN)


def test_a_name_without_a_file_finds_the_shipped_pipeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_pipeline("mini").name == "mini.yaml"
    (tmp_path / "mini").touch()
    assert find_pipeline("mini") == Path("mini")


def test_a_missing_calibration_is_reported_with_both_places_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (said,) = tactflow.check("mini", settings={"calibration": "gel.yaml"})
    assert str(find_pipeline("mini").with_name("gel.yaml")) in str(said)
    assert f"or {tmp_path / 'gel.yaml'}" in str(said)


def test_an_unknown_name_is_reported_with_the_closest_one() -> None:
    with pytest.raises(ConfigError, match=r"no pipeline of that name in tactflow; did you mean tactip\?"):
        find_pipeline("tactipp")
    assert find_pipeline("no_such.yaml") == Path("no_such.yaml"), "a file, which the reader reports"
