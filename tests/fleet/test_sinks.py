"""What a sensor's sinks have written decides whether and how it is started again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tactflow.config.load import load_pipeline
from tactflow.engine.graph import Node
from tactflow.fleet.sinks import WatchedSink

STAGES = "stages: {capture: , preprocess: }\n"


def sink(folder: Path, settings: str) -> Node:
    (folder / "pipeline.yaml").write_text(f"{STAGES}sinks: {{out: {settings}}}\n")
    return load_pipeline(folder / "pipeline.yaml").nodes["out"]


@pytest.fixture
def pictures(tmp_path: Path) -> dict[str, Any]:
    return {"folder": tmp_path / "pictures", "use": "use: images, in: {annotated: preprocess.image}"}


def test_a_folder_with_pictures_is_refused_unless_they_may_be_replaced(
    tmp_path: Path, pictures: dict[str, Any]
) -> None:
    folder, use = pictures["folder"], pictures["use"]
    watched = WatchedSink(sink(tmp_path, f"{{{use}, folder: {folder}}}"))
    assert watched.refused is None
    folder.mkdir()
    assert watched.refused is None
    (folder / "frame-000000.png").touch()
    assert watched.refused == folder
    assert WatchedSink(sink(tmp_path, f"{{{use}, folder: {folder}, overwrite: true}}")).refused is None


def test_a_file_that_was_begun_is_continued_and_one_from_before_is_replaced(tmp_path: Path) -> None:
    file = tmp_path / "out.jsonl"
    file.write_text("{}\n")
    watched = WatchedSink(sink(tmp_path, f"{{use: jsonl, path: {file}, overwrite: true}}"))
    assert (watched.overrides, watched.refused) == ([], None)
    file.write_text("{}\n{}\n")
    assert watched.overrides == ["sinks.out.overwrite=false", "sinks.out.append=true"]
