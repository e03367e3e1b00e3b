"""A batch does what is missing, and believes nothing that it cannot check."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path

import orjson
import pytest

from tactflow.engine.errors import ConfigError
from tactflow.sinks.jsonl import Jsonl
from tests.batch.doubles import Batch, recording


@pytest.fixture
def batch(tmp_path: Path) -> Batch:
    """Three recordings of which nothing is done."""
    made = Batch(tmp_path)
    for number in range(3):
        recording(made.recordings / f"{number}.npy", brightness=150 + number)
    return made


def statuses(batch: Batch, *, verify: bool = False) -> list[str]:
    found = sorted(batch(verify=verify).outcomes.values(), key=lambda outcome: outcome.name)
    return [f"{o.name} {o.status}{' before' if o.reused else ''}" for o in found]


def test_every_recording_has_a_result_of_every_frame_and_a_second_call_does_nothing(batch: Batch) -> None:
    assert statuses(batch) == ["0.npy done", "1.npy done", "2.npy done"]
    (path,) = batch.folder.results.glob("1.npy-*.jsonl")
    messages = [orjson.loads(line) for line in path.read_bytes().splitlines()]
    assert [bool(message["contact"]) for message in messages] == [False] * 2 + [True] * 4
    assert statuses(batch) == ["0.npy done before", "1.npy done before", "2.npy done before"]
    assert batch.executor.submitted == []
    assert batch.plan.words == "3 recordings, 3 done before, 0 new or failed before"
    assert not list(batch.folder.unfinished.iterdir())


def test_only_what_has_changed_is_done_again(batch: Batch) -> None:
    batch()
    recording(batch.recordings / "1.npy", brightness=250)
    assert statuses(batch) == ["0.npy done before", "1.npy done", "2.npy done before"]
    assert batch.plan.changed == 1
    batch("stages.hull.min_area=7")
    assert len(batch.executor.submitted) == 3


@pytest.mark.parametrize("damage", ["cut off", "gone", "other bytes", "no record"])
def test_a_result_that_is_not_as_it_was_written_is_no_result(batch: Batch, damage: str) -> None:
    batch()
    (path,) = batch.folder.results.glob("2.npy-*")
    whole = path.read_bytes()
    if damage == "cut off":
        os.truncate(path, 100)
    elif damage == "gone":
        path.unlink()
    elif damage == "other bytes":
        path.write_bytes(b"x" * len(whole))
    else:
        for record in batch.folder.records.iterdir():
            record.unlink()
    assert statuses(batch)[2] == "2.npy done"
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    "change", [{"frames": "many"}, {"notes": 5}, {"started": None}, {"more": 1}, {"result": "../records"}]
)
def test_a_line_of_the_ledger_that_is_not_ours_counts_for_nothing(
    batch: Batch, change: dict[str, object]
) -> None:
    batch()
    ledger = batch.folder.ledgers / "1-of-1.jsonl"
    lines = [json.loads(line) | change for line in ledger.read_text().split("\n") if line]
    ledger.write_text("\n".join(map(json.dumps, lines)))
    assert statuses(batch) == ["0.npy done before", "1.npy done before", "2.npy done before"]


@pytest.mark.parametrize(
    "record", [b"[]", b"{}", b'{"outcome": null}', b'{"curve": [[1]], "pictures": [{"jpeg": "<script>"}]}']
)
def test_a_record_that_is_not_ours_is_none(batch: Batch, record: bytes) -> None:
    batch()
    (first, *_) = batch.folder.records.iterdir()
    assert batch.folder.record(first.stem) is not None
    first.write_bytes(record)
    assert batch.folder.record(first.stem) is None


def test_tables_are_whole_only_with_all_their_parts(batch: Batch) -> None:
    pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'tactflow[parquet]'")
    batch.format = "parquet"
    batch()
    (tables,) = batch.folder.results.glob("1.npy-*")
    parts = {path: path.read_bytes() for path in tables.rglob("*.parquet")}
    assert len(parts) == 3
    next(iter(parts)).unlink()
    assert statuses(batch) == ["0.npy done before", "1.npy done", "2.npy done before"]
    assert {path: path.read_bytes() for path in tables.rglob("*.parquet")} == parts


def test_a_change_that_size_and_time_do_not_show_is_found_by_verify(batch: Batch) -> None:
    batch()
    (path,) = batch.folder.results.glob("0.npy-*")
    times, whole = path.stat(), path.read_bytes()
    path.write_bytes(b"x" * len(whole))
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert statuses(batch)[0] == "0.npy done before"
    assert statuses(batch, verify=True)[0] == "0.npy done"
    assert path.read_bytes() == whole


def test_a_recording_that_was_moved_is_known_again_also_without_a_ledger(batch: Batch) -> None:
    batch()
    (batch.recordings / "2.npy").rename(batch.recordings / "9.npy")
    (batch.folder.ledgers / "1-of-1.jsonl").write_bytes(b'{"recording": "cut o')
    assert statuses(batch) == ["0.npy done before", "1.npy done before", "9.npy done before"]


def test_one_that_fails_stops_no_other_and_is_tried_again(batch: Batch) -> None:
    (batch.recordings / "1.npy").write_bytes(b"no array")
    result = batch()
    (failed,) = result.failed
    assert (failed.name, failed.status) == ("1.npy", "failed")
    assert "not a .npy file" in str(failed.error)
    assert statuses(batch) == ["0.npy done before", "1.npy failed", "2.npy done before"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such files")
def test_a_pipe_or_a_device_fails_and_nobody_waits_for_its_end(batch: Batch) -> None:
    os.mkfifo(batch.recordings / "pipe.npy")
    (batch.recordings / "endless.npy").symlink_to("/dev/zero")
    (batch.recordings / "pictures").mkdir()
    (batch.recordings / "pictures" / "1.png").symlink_to("/dev/zero")
    result = batch()
    assert len(result.outcomes) == 3 + len(result.failed)
    assert [outcome.error for outcome in result.failed] == [
        f"{batch.recordings / name}: cannot be read: it is a pipe or a device, not a file"
        for name in ("endless.npy", "pipe.npy", "pictures/1.png")
    ]


def test_fail_fast_begins_nothing_more(batch: Batch) -> None:
    (batch.recordings / "0.npy").write_bytes(b"no array")
    result = batch(fail_fast=True)
    # What had begun is finished.
    assert len(result.outcomes) == 2
    assert [one.name for one in result.undone] == ["2.npy"]


def test_one_signal_finishes_what_runs_and_leaves_the_rest_for_the_next_call(batch: Batch) -> None:
    result = batch(stop_after=1)
    assert (len(result.outcomes), len(result.undone), result.ended) == (2, 1, "interrupted")
    assert not batch.executor.killed
    assert statuses(batch) == ["0.npy done before", "1.npy done before", "2.npy done"]


def test_a_full_disk_ends_the_batch_and_loses_nothing(batch: Batch, monkeypatch: pytest.MonkeyPatch) -> None:
    batch(stop_after=1)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Jsonl, "_flush", full)
        result = batch()
    assert result.ended is not None
    assert result.ended.startswith("the disk is full")
    assert sum(outcome.reused for outcome in result.outcomes.values()) == 2
    assert not list(batch.folder.unfinished.iterdir())
    assert statuses(batch) == ["0.npy done before", "1.npy done before", "2.npy done"]


def test_two_calls_do_not_work_in_one_folder_but_two_shards_do(batch: Batch) -> None:
    with batch.folder.claimed("1-of-1"), pytest.raises(ConfigError, match="another tactflow batch"):
        batch()
    with batch.folder.claimed("1-of-2"), batch.folder.claimed("2-of-2"):
        assert len(list(batch.folder.unfinished.iterdir())) == 2


def test_code_beside_the_pipeline_belongs_to_what_a_result_is_kept_under(batch: Batch) -> None:
    code = batch.file.parent / "dim.py"
    code.write_text(
        "from tactflow import Stage\nfrom tactflow.ports import Image\n"
        "class Dim(Stage):\n    memory = 'pure'\n"
        "    def process(self, image: Image) -> Image:\n        return image // 2\n"
    )
    text = batch.file.read_text().replace("preprocess.image", "dim.image")
    batch.file.write_text(text.replace("  difference", "  dim: {use: ./dim.py}\n  difference"))
    batch()
    code.write_text(code.read_text().replace("// 2", "// 3"))
    batch()
    assert batch.plan.changed == 3
