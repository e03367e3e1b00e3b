"""What is written can be read back, and is what the scene shows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tactflow.calibration.reference import read_reference
from tactflow.sim import export, open_scene
from tactflow.sim.scenes import Scene


@pytest.fixture
def scene() -> Scene:
    return open_scene("slide?frames=12")


def test_truth_as_json_lines_is_the_truth(scene: Scene, tmp_path: Path) -> None:
    export.write_truth(scene, tmp_path / "a.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert len(lines) == 12
    touched = 0
    for index, line in enumerate(lines):
        truth = scene.truth(index)
        assert set(line) == {
            "frame", "t", "touching", "center", "angle", "hull", "area", "depth", "origin", "position",
            "visible", "mean_flow",
        }  # fmt: skip
        assert line["frame"] == index
        assert line["t"] == pytest.approx(index / 60)
        assert line["touching"] == truth.touching
        assert (line["center"] is None) == (truth.center is None)
        np.testing.assert_array_equal(line["position"], truth.position)
        np.testing.assert_array_equal(line["origin"], truth.origin)
        np.testing.assert_array_equal(line["visible"], truth.visible)
        touched += truth.touching
    assert touched > 3


def test_a_csv_holds_what_a_force_gauge_would_say(scene: Scene, tmp_path: Path) -> None:
    export.write_truth(scene, tmp_path / "a.csv")
    gauge = read_reference(tmp_path / "a.csv")
    assert gauge.time.tolist() == pytest.approx([i / 60 for i in range(12)])
    np.testing.assert_allclose(gauge.force, [scene.truth(i).force for i in range(12)])
    assert gauge.force[:, 2].max() > 0.1
