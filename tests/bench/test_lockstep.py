from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.bench.lockstep import LockstepPipeline, Outcome
from tactflow.bench.pipelines import on_recording, take_turns
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.sources.files import ArrayFile

STAGES = '''
import numpy as np
from tactflow.engine.contract import Stage
from tactflow.engine.frame import Absent, Frame
from tactflow.ports import ContactMask
from tactflow.vision.types import Contact

class Mean(Stage):
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


def test_a_block_is_so_many_frames_and_the_last_one_is_what_is_left(
    pipeline: Pipeline, tmp_path: Path
) -> None:
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 0, 10, 20, 30, 40)), None)
    blocks = [lockstep.block(2) for _ in range(5)]
    lockstep.close()
    assert [[o.frame.seq for o in outcomes] for outcomes in blocks] == [[0, 1], [2, 3], [4], [], []]
    areas = [[o.contact.area if o.contact else None for o in outcomes] for outcomes in blocks]
    assert areas == [[None, 10], [20, 30], [40], [], []]


def test_a_recording_that_ends_with_a_block_gives_an_empty_one_next(
    pipeline: Pipeline, tmp_path: Path
) -> None:
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1, 2)), None)
    assert [len(lockstep.block(2)) for _ in range(3)] == [2, 0, 0]
    lockstep.close()


def test_no_frame_is_touched_beyond_the_block(pipeline: Pipeline, tmp_path: Path) -> None:
    lines = tmp_path / "lines.jsonl"
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1, 2, 3, 4)), lines)
    lockstep.block(3)
    lockstep.close()
    assert [json.loads(line)["seq"] for line in lines.read_text().splitlines()] == [0, 1, 2]


def test_what_came_before_a_failure_in_the_middle_of_a_block_is_kept(
    pipeline: Pipeline, tmp_path: Path
) -> None:
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 1, 2, 255, 3)), None)
    assert [o.frame.seq for o in lockstep.block(4)] == [0, 1]
    for _ in range(2):
        with pytest.raises(TactflowError, match="too bright"):
            lockstep.block(4)
    lockstep.close()


def test_a_frames_time_is_its_own_and_not_that_of_its_block(tmp_path: Path) -> None:
    source = """
import time
from tactflow.engine.contract import Stage
from tactflow.engine.frame import Frame
from tactflow.vision.types import Contact
import numpy as np

class Sleeps(Stage):
    memory = "pure"
    def __init__(self, params): ...
    def process(self, frame: Frame) -> Contact:
        level = int(frame.image[0, 0, 0])
        time.sleep(level / 1e3)
        return Contact(float(level), (0.0, 0.0), None, None, np.zeros((0, 2)), None)
"""
    (tmp_path / "stages.py").write_text(source)
    text = PIPELINE.replace("stages.py:Mean", "stages.py:Sleeps")
    (tmp_path / "pipeline.yaml").write_text(text)
    slow = load_pipeline(tmp_path / "pipeline.yaml")
    lockstep = LockstepPipeline(on_recording(slow, recording(tmp_path, 0, 60, 0, 30)), None)
    outcomes = lockstep.block(4)
    lockstep.close()
    # A sleep never ends early and costs the processor nothing: both hold on the busiest machine.
    assert outcomes[1].wall >= 0.06
    assert outcomes[3].wall >= 0.03
    assert all(outcome.cpu < outcome.wall for outcome in outcomes[1::2])


def test_what_it_takes_to_read_a_recording_is_no_part_of_a_frames_time(
    pipeline: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = ArrayFile.read

    def slow(self: ArrayFile) -> tuple[NDArray[np.uint8], float] | None:
        time.sleep(0.05)
        return read(self)

    monkeypatch.setattr(ArrayFile, "read", slow)
    lockstep = LockstepPipeline(on_recording(pipeline, recording(tmp_path, 0, 10, 20), settle=0), None)
    began = time.perf_counter()
    outcomes = lockstep.block(3)
    took = time.perf_counter() - began
    lockstep.close()
    # Reading all of it is in what the turn took, and in no frame's time.
    assert took - sum(outcome.wall for outcome in outcomes) >= 4 * 0.05


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


def test_pipelines_take_turns_of_a_few_frames_and_each_sees_every_frame_once(
    pipeline: Pipeline, tmp_path: Path
) -> None:
    three = {
        "a": on_recording(pipeline, recording(tmp_path, 1, 2, 3)),
        "long": on_recording(pipeline, recording(tmp_path, 1, 2, 3, 4, 5)),
        "one": on_recording(pipeline, recording(tmp_path, 1)),
    }
    seen: list[tuple[str, int]] = []
    steps: list[int] = []

    def see(name: str, outcome: Outcome) -> str:
        seen.append((name, outcome.frame.seq))
        return "idle"

    times, failures = take_turns(three, tmp_path, CopyUnit(), see, lambda: steps.append(len(seen)), block=2)
    assert not failures
    assert seen == [
        *(("a", 0), ("a", 1), ("long", 0), ("long", 1), ("one", 0)),
        *(("a", 2), ("long", 2), ("long", 3)),
        ("long", 4),
    ]
    # One step for every frame of the longest recording, after its turn.
    assert steps == [5, 5, 8, 8, 9]
    counts = {name: sum(len(s.cpu) for s in kinds.values()) for name, kinds in times.samples.items()}
    assert counts == {"a": 3, "long": 5, "one": 1}


def test_a_time_belongs_to_the_kind_of_its_own_frame(pipeline: Pipeline, tmp_path: Path) -> None:
    levels = (9, 0, 10, 0, 20, 30)
    one = {"one": on_recording(pipeline, recording(tmp_path, *levels))}
    measured: dict[str, list[float]] = {}

    def see(_name: str, outcome: Outcome) -> str:
        kind = "contact" if outcome.contact is not None else "idle"
        measured.setdefault("reference" if outcome.frame.reference else kind, []).append(outcome.wall)
        return kind

    times, _ = take_turns(one, tmp_path, CopyUnit(), see, lambda: None, block=4)
    assert {kind: samples.wall for kind, samples in times.samples["one"].items()} == measured
    assert {kind: len(walls) for kind, walls in measured.items()} == {"reference": 1, "idle": 2, "contact": 3}


@pytest.mark.parametrize("block", [1, 2, 3, 20])
def test_a_failure_of_one_pipeline_does_not_stop_the_others(
    pipeline: Pipeline, tmp_path: Path, block: int
) -> None:
    both = {
        "good": on_recording(pipeline, recording(tmp_path, 1, 2, 3)),
        "bad": on_recording(pipeline, recording(tmp_path, 1, 255, 3)),
    }
    seen: list[tuple[str, int]] = []

    def see(name: str, outcome: Outcome) -> str:
        seen.append((name, outcome.frame.seq))
        return "idle"

    times, failures = take_turns(both, tmp_path, CopyUnit(), see, lambda: None, block=block)
    assert [seq for name, seq in seen if name == "good"] == [0, 1, 2]
    assert [seq for name, seq in seen if name == "bad"] == [0]
    assert list(failures) == ["bad"]
    assert "too bright" in failures["bad"]
    assert times.samples["good"]["idle"].summary()["count"] == 2
    assert times.samples["good"]["reference"].summary()["count"] == 1
    assert times.stages["good"].keys() >= {"mean", "jsonl"}


def test_a_pipeline_that_cannot_be_opened_is_a_failure(pipeline: Pipeline, tmp_path: Path) -> None:
    missing = {"x": on_recording(pipeline, tmp_path / "not_there.npy")}
    _, failures = take_turns(missing, tmp_path, CopyUnit(), lambda *_: "idle", lambda: None)
    assert "not_there" in failures["x"]
