from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest

from tactflow.bench.lockstep import LockstepPipeline
from tactflow.bench.pipelines import on_recording, take_turns
from tactflow.bench.timing import CopyUnit
from tactflow.engine.config import load_pipeline
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline

STAGES = '''
import numpy as np
from tactflow.engine.frame import Absent, Frame
from tactflow.ports import ContactMask
from tactflow.vision.types import Contact

class Mean:
    """A contact whose area is the mean of the frame; none in black frames."""
    memory = "pure"
    def __init__(self, params): ...
    def process(self, frame: Frame) -> Contact | Absent:
        value = float(frame.image.mean())
        if value > 200:
            raise ValueError("too bright")
        if value == 0:
            return Absent("no_contact")
        return Contact(value, (0.0, 0.0), None, None, np.zeros((0, 2)), None)
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


def recording(tmp_path: Path, *levels: int) -> Path:
    path = tmp_path / f"{'-'.join(map(str, levels))}.npy"
    np.save(path, np.stack([np.full((6, 8, 3), level, np.uint8) for level in levels]))
    return path


def test_one_step_is_one_frame_and_its_values(pipeline: Pipeline, tmp_path: Path) -> None:
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 0, 10, 20)), None)
    outcomes = []
    while (outcome := lockstep.step()) is not None:
        outcomes.append(outcome)
    lockstep.close()
    assert [o.frame.seq for o in outcomes] == [0, 1, 2]
    assert [o.frame.reference for o in outcomes] == [True, False, False]
    assert [o.contact.area if o.contact else None for o in outcomes] == [None, 10, 20]
    assert all(o.wall > 0 for o in outcomes)
    assert all(o.flow is None and o.markers is None and o.mapping is None for o in outcomes)


def test_no_frame_is_touched_before_its_turn(pipeline: Pipeline, tmp_path: Path) -> None:
    lines = tmp_path / "lines.jsonl"
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1, 2, 3)), lines)
    lockstep.step()
    lockstep.step()
    lockstep.close()
    assert [json.loads(line)["seq"] for line in lines.read_text().splitlines()] == [0, 1]


def test_the_pipelines_own_sinks_are_left_out(pipeline: Pipeline, tmp_path: Path) -> None:
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1)), None)
    lockstep.step()
    lockstep.close()
    assert not (tmp_path / "never_written.jsonl").exists()
    assert not Path("never_written.jsonl").exists()


def test_every_node_runs_in_one_thread(pipeline: Pipeline, tmp_path: Path) -> None:
    before = threading.active_count()
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1)), None)
    lockstep.step()
    # One for the engine's run, one for its only segment.
    assert threading.active_count() == before + 2
    lockstep.close()
    assert threading.active_count() == before


def test_a_failing_stage_is_reported_with_its_frame(pipeline: Pipeline, tmp_path: Path) -> None:
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1, 255)), None)
    lockstep.step()
    with pytest.raises(TactflowError, match="too bright"):
        lockstep.step()
    lockstep.close()


def test_a_failure_of_one_pipeline_does_not_stop_the_others(pipeline: Pipeline, tmp_path: Path) -> None:
    both = {
        "good": on_recording(pipeline, recording(tmp_path, 1, 2, 3)),
        "bad": on_recording(pipeline, recording(tmp_path, 1, 255, 3)),
    }
    seen: list[tuple[str, int]] = []

    def see(name: str, outcome: object) -> str:
        seen.append((name, outcome.frame.seq))  # type: ignore[attr-defined]
        return "idle"

    times, failures = take_turns(both, tmp_path, CopyUnit(), see, lambda: None)
    assert seen == [("good", 0), ("bad", 0), ("good", 1), ("good", 2)]
    assert list(failures) == ["bad"]
    assert times.samples["good"]["idle"].summary()["count"] == 2
    assert times.samples["good"]["reference"].summary()["count"] == 1
    assert times.stages["good"].keys() >= {"mean", "jsonl"}


def test_a_pipeline_that_cannot_be_opened_is_a_failure(pipeline: Pipeline, tmp_path: Path) -> None:
    missing = {"x": on_recording(pipeline, tmp_path / "not_there.npy")}
    _, failures = take_turns(missing, tmp_path, CopyUnit(), lambda *_: "idle", lambda: None)
    assert "not_there" in failures["x"]
