"""Stage `pose`."""

from __future__ import annotations

import numpy as np

import tactflow
from tactflow.engine.contract import StageParams
from tactflow.engine.frame import Absent, Frame
from tactflow.stages.pose import Pose
from tactflow.vision.types import Depth, Scale
from tactflow.vision.types import Pose as ObjectPose

Y, X = np.mgrid[:100, :100]
HEIGHTS = np.maximum(0.9 - 0.001 * ((X - 50) ** 2 + (Y - 50) ** 2), 0).astype(np.float32)
DEPTH = Depth(HEIGHTS, 0.9, None, 1.0, None)
MASK = np.where(HEIGHTS > 0, 255, 0).astype(np.uint8)
SCALE = Scale(0.05, 0.05, (0.0, 0.0), (49.5, 49.5))


def step(stage: Pose, seq: int, touching: bool = True) -> ObjectPose | Absent:
    frame = Frame("main", seq, 0.0, np.zeros((100, 100, 3), np.uint8))
    return stage.process(frame, touching, MASK, SCALE, DEPTH)


def test_the_pose_is_counted_from_the_frame_in_which_the_contact_began() -> None:
    stage = Pose(StageParams())
    first, second = step(stage, 3), step(stage, 4)
    assert (first.since, first.translation) == (3, (0, 0, 0))
    assert second.since == 3
    assert np.abs(second.translation).max() < 0.001


def test_without_contact_or_with_a_new_reference_the_object_is_forgotten() -> None:
    stage = Pose(StageParams())
    step(stage, 3)
    assert step(stage, 4, touching=False) == Absent("no_contact")
    assert step(stage, 5).since == 5
    stage.reset()
    assert step(stage, 6).since == 6


def test_without_heights_it_says_what_is_missing() -> None:
    results = list(tactflow.stream(source="sim:press?frames=30", settings={"stages.pose": {}}))
    assert {result.skipped.get("pose") for result in results if result.contact} == {"no_calibration"}
