"""What a sensor's sinks have written decides whether and how it is started again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tactflow.config.load import load_pipeline
from tactflow.engine.graph import Node
from tactflow.tools.fleet.sinks import WatchedSink, shared_addresses

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
    folder.mkdir()
    settings = f"{{{use}, folder: {folder}}}"
    assert WatchedSink(sink(tmp_path, settings)).refused is None
    (folder / "frame-000000.png").touch()
    assert WatchedSink(sink(tmp_path, settings)).refused == folder
    assert WatchedSink(sink(tmp_path, f"{{{use}, folder: {folder}, overwrite: true}}")).refused is None


@pytest.mark.parametrize(
    ("use", "parameter", "begun", "next_one"),
    [
        ("use: images, in: {annotated: preprocess.image}", "folder", "shots/frame-000000.png", "shots-001"),
        ("use: video, in: {annotated: preprocess.image}", "path", "film.avi", "film-001.avi"),
        ("use: record", "path", "press.mcap", "press-001.mcap"),
    ],
)
def test_what_cannot_be_continued_goes_on_beside_what_was_begun(
    tmp_path: Path, use: str, parameter: str, begun: str, next_one: str
) -> None:
    output = tmp_path / Path(begun).parts[0]
    watched = WatchedSink(sink(tmp_path, f"{{{use}, {parameter}: {output}, overwrite: true}}"))
    assert watched.overrides == []
    (tmp_path / begun).parent.mkdir(exist_ok=True)
    (tmp_path / begun).write_text("begun")
    for number in ("-001", "-002"):
        expected = tmp_path / next_one.replace("-001", number)
        assert watched.overrides == [f'sinks.out.{parameter}="{expected}"', "sinks.out.overwrite=false"]
        assert watched.refused is None
        expected.touch()


def test_a_file_that_was_begun_is_continued_and_one_from_before_is_replaced(tmp_path: Path) -> None:
    file = tmp_path / "out.jsonl"
    file.write_text("{}\n")
    watched = WatchedSink(sink(tmp_path, f"{{use: jsonl, path: {file}, overwrite: true}}"))
    assert (watched.overrides, watched.refused) == ([], None)
    file.write_text("{}\n{}\n")
    assert watched.overrides == ["sinks.out.overwrite=false", "sinks.out.append=true"]


def test_the_last_messages_get_the_longest_time_that_one_of_the_sensors_gives_them(tmp_path: Path) -> None:
    file = tmp_path / "pipeline.yaml"
    sensors = "sensors: {left: , right: {sinks: {zmq: {linger: 7}}}}"
    file.write_text(f"{sensors}\n{STAGES}sinks: {{zmq: {{linger: 3}}}}\n")
    pipelines = {name: load_pipeline(file, sensor=name) for name in ("left", "right")}
    (shared,) = shared_addresses(pipelines)
    assert (shared.together.linger, shared.together.backlog) == (7, 64)
