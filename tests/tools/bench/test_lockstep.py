from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.engine.graph import Pipeline
from tactflow.tools.bench.lockstep import LockstepPipeline, TimedResult, on_recording, take_turns

STAGES = '''
import time
import numpy as np
from tactflow import Absent, Contact, Frame, Stage

class Mean(Stage):
    """A contact whose area is the mean of the frame; none in black frames."""
    memory = "pure"
    def process(self, frame: Frame) -> Contact | Absent:
        value = float(frame.image.mean())
        if value > 200:
            raise ValueError("too bright")
        if value == 0:
            return Absent("no_contact")
        return Contact(value, (0.0, 0.0), None, None, np.zeros((0, 2)), None)

class Works(Stage):
    """Computes for as many ms as the frame has grey levels."""
    memory = "pure"
    def process(self, frame: Frame) -> Contact:
        began = time.thread_time()
        while time.thread_time() - began < frame.image[0, 0, 0] / 1e3:
            pass
        return Contact(1.0, (0.0, 0.0), None, None, np.zeros((0, 2)), None)
'''

PIPELINE = """
sensor: test
stages:
  capture: {source: "nothing.npy"}
  mean: {use: "./stages.py:Mean", segment: own}
sinks:
  file: {use: jsonl, path: never_written.jsonl}
"""


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    (tmp_path / "stages.py").write_text(STAGES)
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    return load_pipeline(tmp_path / "pipeline.yaml")


def recorded(pipeline: Pipeline, tmp_path: Path, *levels: int) -> Pipeline:
    """The pipeline on a recording of frames of these grey levels."""
    path = tmp_path / f"{'-'.join(map(str, levels))}.npy"
    np.save(path, np.stack([np.full((6, 8, 3), level, np.uint8) for level in levels]))
    return on_recording(pipeline, path)


@pytest.mark.usefixtures("pipeline")
def test_a_frames_time_is_its_own(tmp_path: Path) -> None:
    slow = load_pipeline(tmp_path / "pipeline.yaml", ["stages.mean.use=./stages.py:Works"])
    lockstep = LockstepPipeline(recorded(slow, tmp_path, 0, 60, 0, 30))
    times = [result.cpu_s for result in lockstep.block(4)]
    lockstep.close()
    # Its own thread's time: what others take on a busy machine does not count.
    assert times[1] >= 0.06
    assert times[3] >= 0.03
    assert times[2] < times[3] < times[1]


def test_pipelines_take_turns_and_each_sees_every_frame_once(pipeline: Pipeline, tmp_path: Path) -> None:
    three = {
        "a": recorded(pipeline, tmp_path, 1, 2, 3),
        "long": recorded(pipeline, tmp_path, 1, 0, 3, 4, 5),
        "one": recorded(pipeline, tmp_path, 1),
    }
    order: list[tuple[str, int]] = []

    def see(name: str, result: TimedResult) -> str:
        order.append((name, result.seq))
        return "idle" if result.contact is None else "contact"

    times, failures = take_turns(three, see, block=2)
    assert not failures
    first = [("a", 0), ("a", 1), ("long", 0), ("long", 1), ("one", 0)]
    assert order == [*first, ("a", 2), ("long", 2), ("long", 3), ("long", 4)]
    counts = {name: {kind: len(samples) for kind, samples in kinds.items()} for name, kinds in times.items()}
    assert counts == {
        "a": {"reference": 1, "contact": 2},
        "long": {"reference": 1, "idle": 1, "contact": 3},
        "one": {"reference": 1},
    }


@pytest.mark.parametrize("block", [1, 2, 20])
def test_a_failure_of_one_pipeline_does_not_stop_the_others(
    pipeline: Pipeline, tmp_path: Path, block: int
) -> None:
    three = {
        "good": recorded(pipeline, tmp_path, 1, 2, 3),
        "bad": recorded(pipeline, tmp_path, 1, 255, 3),
        "missing": on_recording(pipeline, tmp_path / "not_there.npy"),
    }
    times, failures = take_turns(three, lambda *_: "idle", block=block)
    assert len(times["good"]["idle"]) == 2
    assert set(failures) == {"bad", "missing"}
    assert "too bright" in failures["bad"]
    assert "not_there" in failures["missing"]
