"""Labelling: the file of labels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tactflow.bench.label_file import FrameLabel, load_labels, save_labels
from tactflow.engine.errors import ConfigError, StageError

TRIANGLE = ((10.0, 10.0), (50.5, 10.0), (30.0, 40.0))


def entry(**changes: Any) -> dict[str, Any]:
    """One entry of the file, as JSON has it."""
    plain = {"recording": "left", "frame": 3, "reference": 0, "contact": True, "outlines": [TRIANGLE]}
    return plain | changes


def test_a_file_of_labels_is_read_as_it_was_written(tmp_path: Path) -> None:
    labels = [
        FrameLabel(recording="left", frame=3, reference=0, lab="A", contact=True, outlines=(TRIANGLE,)),
        FrameLabel(recording="left", frame=3, reference=0, lab="A", round=2, contact=None),
        FrameLabel(recording="finger/ü", frame="003", reference="000", contact=False, dots=((1.5, 2.0),)),
    ]
    save_labels(tmp_path / "labels.json", labels)
    assert load_labels(tmp_path / "labels.json") == labels
    first, second, third = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    assert first["outlines"] == [[list(point) for point in TRIANGLE]]
    assert second["contact"] is None
    assert "dots" not in first
    assert third["dots"] == [[1.5, 2.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a file of labels: Invalid JSON"),
        ("{}", "not a file of labels: .* array"),
        ([entry(), {"recording": "left"}], "entry 2, frame: Field required"),
        ([entry(frame=1.5)], "entry 1, frame"),
        ([entry(outlins=[])], "entry 1, outlins: "),
        ([entry(outlines=[TRIANGLE[:2]])], "entry 1: an outline requires 3 points or more"),
        ([entry(contact=None)], "entry 1: outlines require contact true"),
        ([entry(outlines=[[*TRIANGLE, [0, float("nan")]]])], r"entry 1, outlines.0.3.1: .* finite"),
        ([entry(), entry(round=2), entry()], "entry 3: the same frame and round as entry 1"),
    ],
)
def test_a_broken_file_of_labels_is_refused(text: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    with pytest.raises(ConfigError, match=f"^{path}: {message}"):
        load_labels(path)


def test_a_missing_file_and_an_impossible_one_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no.json: cannot be read: No such file"):
        load_labels(tmp_path / "no.json")
    (tmp_path / "file").touch()
    with pytest.raises(StageError, match="cannot be written"):
        save_labels(tmp_path / "file" / "labels.json", [])
