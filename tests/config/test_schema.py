"""The schemas accept what the program accepts and refuse what an editor should underline."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from tactflow.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
PIPELINES = [*sorted(ROOT.glob("pipelines/*.yaml")), ROOT / "pipeline.yaml"]


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    """Of pipeline files."""
    from tactflow.config.registry import catalogue
    from tactflow.config.schema import pipeline_schema

    schema = pipeline_schema(catalogue()[0])
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def places(validator: Draft202012Validator, text: str) -> list[str]:
    return [error.json_path for error in validator.iter_errors(yaml.safe_load(text))]


@pytest.mark.parametrize("path", PIPELINES, ids=lambda p: p.stem)
def test_every_shipped_pipeline_fits_the_schema(path: Path, validator: Draft202012Validator) -> None:
    assert places(validator, path.read_text()) == []


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("{}", "$"),
        ("{stages: {capture: }, sink: {}}", "$"),
        ("{stages: {capture: }, sensor: a b}", "$.sensor"),
        ("stages: {capture: {sorce: a}}", "$.stages.capture"),
        ("stages: {capture: {skip: -1}}", "$.stages.capture.skip"),
        ("stages: {hull: {queue: {when_full: lates}}}", "$.stages.hull.queue.when_full"),
        ("stages: {hull: {max_rate: 5}}", "$.stages.hull"),
        ("stages: {hull: {when: {signal: touching}}}", "$.stages.hull.when"),
        ("{stages: {capture: }, gel: {tnt: 1}}", "$.gel"),
        ("{stages: {capture: }, gel: {tint: 2}}", "$.gel.tint"),
        ("{stages: {capture: }, sensors: {}}", "$.sensors"),
        ("{stages: {capture: }, sensors: {a b: }}", "$.sensors"),
        ("{stages: {capture: }, sensors: {a: {stage: }}}", "$.sensors.a"),
        ("{stages: {capture: }, sinks: {jsonl: {max_rate: 0}}}", "$.sinks.jsonl.max_rate"),
    ],
)
def test_wrong_pipelines_do_not_fit(text: str, place: str, validator: Draft202012Validator) -> None:
    assert place in places(validator, text)


@pytest.mark.parametrize("what", [["message"], ["pipeline"], []])
def test_the_command_prints_a_schema(what: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", *what]) == 0
    schema: dict[str, Any] = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(schema)
    assert ("stages" in schema["properties"]) == (what == ["pipeline"])
