"""A dataset that LeRobot's own loop records with two of our cameras."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import tactflow
from plugins.lerobot.tests.lerobot_env import needs_datasets, run_with_lerobot
from tactflow.sources import open_source
from tests.paths import REPOSITORY

pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")
pytest.importorskip("av", reason="the extra lerobot is not installed")

RECORD = """
import sys, types
# LeRobot's viewer, which the loop imports and does not use here: 760 MB.
sys.modules.setdefault("rerun", types.ModuleType("rerun"))
sys.path.insert(0, sys.argv.pop(1))
import lerobot_robot_sim_gripper
from lerobot.scripts.lerobot_record import main
main()
"""
MAX_VIDEO_ERROR = 4.0
"""Mean difference of a picture and its copy in a video, grey levels: more than LeRobot's encoder loses."""
SOURCES = {"left": "sim:press?frames=300", "right": "sim:slide?frames=300"}


@needs_datasets
def test_lerobot_records_two_sensors_and_both_can_be_played_again(tmp_path: Path) -> None:
    # A recording that waits for its reader, so that frame i of the dataset is frame i of the recording.
    camera = "type: tactflow, realtime: false, width: 300, height: 400, fps: 5"
    cameras = ", ".join(f'{name}: {{{camera}, source: "{source}"}}' for name, source in SOURCES.items())
    run_with_lerobot(
        RECORD,
        str(REPOSITORY / "examples" / "lerobot"),
        *("--robot.type=sim_gripper", f"--robot.cameras={{{cameras}}}", "--teleop.type=sim_leader"),
        *("--dataset.repo_id=tactflow/press", f"--dataset.root={tmp_path / 'press'}", "--dataset.fps=5"),
        *("--dataset.single_task=press", "--dataset.num_episodes=1", "--dataset.episode_time_s=2"),
        *("--dataset.reset_time_s=0", "--dataset.vcodec=h264", "--dataset.push_to_hub=false"),
        *(
            "--play_sounds=false",
            f"--robot.calibration_dir={tmp_path}",
            f"--teleop.calibration_dir={tmp_path}",
        ),
    )
    info = json.loads((tmp_path / "press" / "meta" / "info.json").read_text())
    assert info["robot_type"] == "sim_gripper"
    assert info["features"]["action"]["names"] == ["left.pos", "right.pos"]
    for name, source in SOURCES.items():
        reader = open_source(f"{tmp_path / 'press'}?camera=observation.images.{name}")
        recorded = [image for image, _ in iter(reader.read, None)]
        reader.close()
        assert len(recorded) == info["total_frames"] > 0
        results = tactflow.stream(source=source, settings={"sinks": {}}, images=True)
        # Without video, LeRobot's loop drops the pictures; a video loses some of the colour.
        for image, result in zip(recorded, results, strict=False):
            assert np.abs(image - 1.0 * result.image).mean() < MAX_VIDEO_ERROR, (name, result.seq)
