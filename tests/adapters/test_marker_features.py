"""Markers in datasets: what `tactflow export` writes of them is what the pipeline found."""

from __future__ import annotations

import json
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import tactflow
from tactflow.adapters.lerobot import DatasetWriter
from tactflow.cli.main import main
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame, Tick
from tactflow.message.episodes import MarkerOrder
from tactflow.message.result import Result
from tactflow.vision.types import Markers
from tests.adapters.lerobot_env import needs_datasets, run_with_lerobot
from tests.messages import Results, result_of

pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
pytest.importorskip("av", reason="the extra lerobot is not installed")

import pyarrow.parquet as pq

SPEC = "sim:press?frames=100"
ORIGIN = np.array([[10.0, 10.0], [30.0, 10.0], [50.0, 10.0], [10.0, 30.0], [30.0, 30.0], [50.0, 30.0]])
MAIN = "observation.tactile.main"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Result]]:
    """A recording as a dataset, and what the pipeline finds in it."""
    out = tmp_path_factory.mktemp("export") / "lerobot"
    with redirect_stderr(StringIO()):
        assert main(["export", "lerobot", SPEC, "--out", str(out), "--pictures", "png"]) == 0
    return out, list(tactflow.stream(source=SPEC, settings={"sinks": {}}, images=True))


def test_a_dataset_holds_what_was_found(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    found = np.stack([r.markers.displacement for r in results if r.markers is not None])
    status = np.stack([r.markers.status for r in results if r.markers is not None])
    assert found.shape == (100, 80, 2)
    assert np.abs(found).max() > 1

    table = pq.read_table(out / "data").to_pydict()
    assert np.array_equal(np.array(table[f"{MAIN}.marker_offset"], np.float32), found.astype(np.float32))
    assert np.array_equal(table[f"{MAIN}.marker_status"], status)


def frames_of(*markers: Markers | None) -> list[Result]:
    """A result for each, ten a second, of 64 x 48 pixels."""
    image = np.zeros((48, 64, 3), np.uint8)
    return [
        result_of(Tick(Frame("main", index, index / 10, image)), Results(image, markers=found))
        for index, found in enumerate(markers)
    ]


def moved(offset: tuple[float, float], origin: np.ndarray = ORIGIN, status: int = 0) -> Markers:
    count = len(origin)
    return Markers(origin, origin + offset, np.full(count, status, np.uint8), np.zeros(count))


def test_markers_keep_their_place_in_recordings_that_found_others(tmp_path: Path) -> None:
    fewer = ORIGIN[[5, 3, 2, 1, 0]] + 2.0
    writer = DatasetWriter(tmp_path, 10, "press")
    for markers in (moved((1.0, 0.0)), moved((3.0, 0.0), fewer)):
        writer.add(frames_of(None, markers))
    writer.finish()
    table = pq.read_table(tmp_path / "data").to_pydict()
    status = [[2] * 6, [0] * 6, [2] * 6, [0, 0, 0, 0, 2, 0]]
    assert table[f"{MAIN}.marker_status"] == status
    assert np.array_equal(np.array(table[f"{MAIN}.marker_offset"])[:, :, 0], np.outer([0, 1, 0, 3], [1] * 6))


def test_a_gel_that_was_moved_is_refused() -> None:
    order = MarkerOrder()
    order.align(moved((0.0, 0.0)))
    with pytest.raises(StageError, match="only 0 of 6 markers are where"):
        order.align(moved((0.0, 0.0), ORIGIN + 10.5))
    with pytest.raises(StageError, match="only 0 of 6"):
        order.align(moved((0.0, 0.0), np.zeros((0, 2))))


def test_a_recording_with_markers_after_one_without_is_refused(tmp_path: Path) -> None:
    writer = DatasetWriter(tmp_path, 10, "press")
    writer.add(frames_of(None))
    with pytest.raises(StageError, match="has markers, and the recordings before have none"):
        writer.add(frames_of(moved((0.0, 0.0))))


OPENED = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("tactflow/press", root=sys.argv[1])
items = [dataset[index] for index in range(len(dataset))]
print(json.dumps([[item[f"observation.tactile.main.{name}"].tolist() for item in items]
    for name in ("marker_offset", "marker_status")]))
"""


@needs_datasets
def test_lerobot_loads_the_markers(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    offsets, status = json.loads(run_with_lerobot(OPENED, str(out)))
    for index, result in enumerate(results):
        assert result.markers is not None
        assert np.array_equal(np.float32(offsets[index]), np.float32(result.markers.displacement))
        assert np.array_equal(status[index], result.markers.status)
