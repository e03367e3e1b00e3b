"""A recording that is cut gives one result, which says so."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tactflow.batch import split
from tactflow.batch.executor import died
from tactflow.batch.task import Outcome
from tests.batch.doubles import Batch, InTurn, recording


@pytest.fixture
def batch(tmp_path: Path) -> Batch:
    """A recording of 80 frames, 30 a second, which parts of a second cut into three."""
    made = Batch(tmp_path)
    recording(made.recordings / "long.npy", frames=80)
    return made


def test_parts_of_a_pipeline_without_memory_are_together_what_the_whole_is(batch: Batch) -> None:
    (whole,) = batch().outcomes.values()
    (parts,) = batch(split=1.0).outcomes.values()
    assert len(batch.executor.submitted) == 3
    assert (parts.frames, parts.touching, parts.contacts) == (80, 78, 1)
    assert (whole.frames, whole.touching, whole.contacts) == (80, 78, 1)
    assert parts.key != whole.key
    assert parts.seconds > 0
    assert "cut into 3 parts" in parts.notes[0]
    results = [batch.folder.results / str(outcome.result) for outcome in (whole, parts)]
    assert results[0].read_bytes() == results[1].read_bytes()
    assert not list(batch.folder.unfinished.iterdir())
    assert [outcome.reused for outcome in batch(split=1.0).outcomes.values()] == [True]


def test_tables_have_the_parts_of_all_parts(batch: Batch) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow: pip install 'tactflow[parquet]'")
    batch.format = "parquet"
    (parts,) = batch(split=1.0).outcomes.values()
    frames = batch.folder.results / str(parts.result) / "frames"
    assert len(list(frames.iterdir())) == 3
    assert pq.read_table(frames)["seq"].to_pylist() == list(range(80))


def test_a_recording_fails_with_any_of_its_parts(batch: Batch, monkeypatch: pytest.MonkeyPatch) -> None:
    finished = InTurn.finished

    def second_dies(executor: InTurn, timeout: float) -> Sequence[Outcome]:
        if executor._tasks and executor._tasks[0].part and executor._tasks[0].part.number == 1:
            return [died(executor._tasks.pop(0), "set aside", "it killed its worker")]
        return finished(executor, timeout)

    with monkeypatch.context() as patched:
        patched.setattr(InTurn, "finished", second_dies)
        (failed,) = batch(split=1.0).failed
    assert (failed.name, failed.status) == ("long.npy", "set aside")
    assert not list(batch.folder.results.iterdir())
    assert not list(batch.folder.records.iterdir())
    # What is left of its parts does not disturb the next call.
    assert not batch(split=1.0).failed


def test_what_is_shorter_than_a_part_is_not_cut(batch: Batch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(split, "_joined", None)
    (whole,) = batch(split=60.0).outcomes.values()
    assert whole.notes == ()
