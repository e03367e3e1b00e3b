"""Skipping against not skipping: the comparison finds what it should, and the shipped pipeline passes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.bench import skipping
from tactflow.bench.skipping import Comparison, compare
from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.sim import open_scene
from tactflow.sim.export import write_frames

ROOT = Path(__file__).resolve().parents[2]
PIPELINE = ROOT / "pipeline.yaml"
MARKERLESS = ROOT / "pipelines" / "markerless.yaml"


# Repeated at least: what is still in the scene, less the six frames that learn the noise and the four after
# each change. Light that drifts or flickers is never still: each frame is worked on, and half as many do.
@pytest.mark.parametrize(
    ("scene", "frames", "repeated"),
    [
        ("hold", 90, 0.3),
        ("creep", 90, 0.0),
        ("drift", 45, 0.0),
        ("drift?drift=0.01", 90, 0.1),
        ("flicker", 45, 0.0),
        ("tap", 90, 0.3),
        ("spike", 90, 0.2),
        ("stutter", 90, 0.1),
        ("border", 90, 0.1),
        ("two", 90, 0.1),
        ("unmarked", 90, 0.1),
    ],
)
def test_the_shipped_pipelines_repeat_results_without_changing_them(
    scene: str, frames: int, repeated: float, tmp_path: Path
) -> None:
    spec = scene + ("&" if "?" in scene else "?") + f"frames={frames}"
    write_frames(open_scene(spec), tmp_path / "scene.npy")
    pipeline = MARKERLESS if scene == "unmarked" else PIPELINE
    found = compare(load_pipeline(pipeline), tmp_path / "scene.npy", scene, tmp_path)
    assert found.frames == frames
    assert found.faults == []
    # What the page on tuning promises.
    assert found.missed == 0
    assert found.stale <= 1
    assert found.repeated >= repeated * found.frames
    assert found.rest < 30, "at least every 30 frames a scene is worked on"


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
        assert result.noise["marker"].rms == pytest.approx(0.1, rel=0.08)
        assert bool(result.faults) == (shift > 0)


@pytest.mark.parametrize("length", [1, 2, 5])
def test_a_number_that_is_far_off_for_more_than_one_frame_is_a_fault(length: int) -> None:
    """It hardly shows in the RMS."""
    random = np.random.default_rng(0)
    result = Comparison("made up")
    rows = []
    for index in range(300):
        fresh = random.normal(0, 0.1, 20)
        fresh[0] += 1.5 * (100 <= index < 100 + length)
        rows.append(skipping._Row(True, {"marker": np.zeros(20)}, {"marker": fresh}))
    skipping._judge(result, rows)
    assert result.rms["marker"] < 2 * result.noise["marker"].rms
    assert (result.late, result.stale) == (length, length)
    assert bool(result.faults) == (length > 1)


def test_noise_is_told_from_a_moving_scene_where_nothing_was_repeated() -> None:
    random = np.random.default_rng(1)
    moving = [
        skipping._Row(False, {}, {"center": np.array([3.0 * i, 0.02 * i * i]) + random.normal(0, 0.1, 2)})
        for i in range(400)
    ]
    noise = skipping._noise_of("center", moving)
    assert noise is not None
    # 796 second differences, whose median is known to 5 %; a bend of 0.04 px is 0.16 of their deviation.
    assert noise.rms == pytest.approx(0.1, rel=0.12)
    assert skipping._noise_of("angle", moving) is None


def test_angles_are_compared_across_the_seam() -> None:
    difference = skipping._difference("angle", np.array([89.0, -89.5]), np.array([-90.0, 90.0]))
    assert difference == pytest.approx([-1.0, 0.5])


def test_a_decision_that_differs_is_a_fault() -> None:
    assert Comparison("made up", decisions=2).faults == ["2 contact decisions differ"]


def test_the_command_prints_all_tables(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(skipping, "SCENES", ("idle",))
    monkeypatch.setattr(skipping, "ADVERSARIES", {"unmarked": "grows slowly"})
    code = main(["bench", "--skipping", "40"])
    out = capsys.readouterr().out
    assert code == 0
    assert "skipping on against off" in out
    assert "made to catch skipping out" in out
    assert "grows slowly" in out
    assert "median CPU time" in out
    assert "unmarked" in out
