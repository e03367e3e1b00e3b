"""Skipping against not skipping: the comparison finds what it should, and the shipped pipeline passes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.bench import skipping
from tactflow.bench.skipping import Comparison, compare
from tactflow.cli.main import main
from tactflow.engine.config import load_pipeline
from tactflow.sim import open_scene
from tactflow.sim.export import write_frames

PIPELINE = Path(__file__).resolve().parents[2] / "pipeline.yaml"


@pytest.mark.parametrize(
    ("scene", "repeated"), [("hold?frames=90", 0.3), ("border?frames=90", 0.0), ("tap?frames=90", 0.3)]
)
def test_the_shipped_pipeline_repeats_results_without_changing_them(
    scene: str, repeated: float, tmp_path: Path
) -> None:
    write_frames(open_scene(scene), tmp_path / "scene.npy")
    found = compare(load_pipeline(PIPELINE), tmp_path / "scene.npy", scene, tmp_path)
    assert found.frames == 90
    assert found.faults == []
    assert found.repeated >= repeated * found.frames


def test_a_repeated_number_that_is_off_by_more_than_noise_is_a_fault() -> None:
    random = np.random.default_rng(0)
    for shift in (0.0, 0.5):
        result = Comparison("made up")
        rows = [
            skipping._Row(True, {"marker": np.zeros(50) + shift}, {"marker": random.normal(0, 0.1, 50)})
            for _ in range(30)
        ]
        skipping._judge(result, rows)
        # 1400 second differences: their deviation is known to 2 %.
        assert result.noise["marker"] == pytest.approx(0.1, rel=0.08)
        assert bool(result.faults) == (shift > 0)


def test_angles_are_compared_across_the_seam() -> None:
    difference = skipping._difference("angle", np.array([89.0, -89.5]), np.array([-90.0, 90.0]))
    assert difference == pytest.approx([-1.0, 0.5])


def test_a_decision_that_differs_is_a_fault() -> None:
    assert Comparison("made up", decisions=2).faults == ["2 contact decisions differ"]


def test_the_command_prints_both_tables(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(skipping, "SCENES", ("idle", "unmarked"))
    code = main(["bench", "--skipping", "40"])
    out = capsys.readouterr().out
    assert code == 0
    assert "skipping on against off" in out
    assert "median CPU time" in out
    assert "unmarked" in out
