"""The Parquet sink: the same numbers as the JSON lines, complete parts, clear errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tactflow.engine.frame import Frame, Tick
from tactflow.message.schema import message_schema
from tactflow.plugins.parquet import parquet as parquet_module
from tactflow.plugins.parquet.parquet import TABLES, Parquet
from tactflow.vision.types import Depth, Force, Scale, Slip
from tests.faults.rig import array, run
from tests.messages import CONTACT, FLOW, MARKERS, PROCESSED, Results, build_message, result_of

pytest.importorskip("pyarrow", reason="the extra parquet is not installed")

import pyarrow.parquet as pq

REPOSITORY = Path(__file__).resolve().parents[3]
SCALE = Scale(0.05, 0.06, (0.0005, 0.0005), (150.0, 200.0))
DEPTH = Depth(np.zeros((4, 3), np.float32), 0.4, 0.1, 3.2, None)
SECOND = replace(CONTACT, area=12.0, angle=None, ellipse=None, hull=CONTACT.hull + 100)
TWO = replace(CONTACT, separate=(CONTACT, SECOND))
SLIP = Slip(True, 0.25, 0.9, (3.0, -4.0), 2.5, 60.0, 7, (0.5, 0.6), 1.5, 3.0)
FORCE = Force((0.1, None, 2.5), (0.01, None, 0.2), True)
MARKERS = replace(MARKERS, probability=np.array([0.999, 0.25, np.nan]))
FOUND = [
    Results(PROCESSED),
    Results(PROCESSED, CONTACT, FLOW, MARKERS),
    Results(PROCESSED, TWO, FLOW, MARKERS, SCALE, DEPTH, None, SLIP, FORCE),
    Results(PROCESSED, SECOND, replace(FLOW, mean=None), replace(MARKERS, stderr=np.zeros(3))),
]
"""What the columns hold: nothing, a contact, all there is, and some of it."""


def tick(seq: int) -> Tick:
    skipped = {"contact": "no_contact"} if seq % len(FOUND) == 0 else {}
    return Tick(Frame("main", seq, seq / 30, PROCESSED), skipped=skipped)


def opened(folder: Path, **params: Any) -> Parquet:
    sink = Parquet(Parquet.Params(path=str(folder), **params))
    sink.open()
    return sink


def write(sink: Parquet, seqs: range) -> list[dict[str, Any]]:
    """Write frames; the messages about them."""
    for seq in seqs:
        sink.write(result_of(tick(seq), FOUND[seq % len(FOUND)]))
    return [build_message(tick(seq), FOUND[seq % len(FOUND)], detail=True) for seq in seqs]


def rows(folder: Path, table: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pq.read_table(folder / table).to_pylist()
    return found


NAMES = {"size": ["width", "height"], "axes": ["major", "minor"], "shear": ["1", "2"]}


def leaves(value: Any, *names: str) -> Iterator[tuple[str, Any]]:
    """Every value of a part of a message that is there, with the name that its column must have."""
    if isinstance(value, dict) and names[-1:] != ("skipped",):
        for key, inner in value.items():
            yield from leaves(inner, *names, key)
    elif isinstance(value, list) and not isinstance(value[0], list):
        for suffix, number in zip(NAMES.get(names[-1], ["x", "y", "z"][: len(value)]), value, strict=True):
            if number is not None:
                yield "_".join([*names, suffix]), number
    elif value is not None:
        yield "_".join(names), list(value.items()) if isinstance(value, dict) else value


def test_the_tables_hold_what_the_messages_say_and_nothing_else(tmp_path: Path) -> None:
    sink = opened(tmp_path)
    messages = write(sink, range(8))
    sink.close()
    assert sink.counters() == {"frames": 8, "parts": 1}
    frames = rows(tmp_path, "frames")
    parts = ("schema", "contacts", "markers")
    for row, message in zip(frames, messages, strict=True):
        kept = {key: value for key, value in message.items() if key not in parts}
        assert {name: value for name, value in row.items() if value is not None} == dict(leaves(kept))
    contacts = rows(tmp_path, "contacts")
    expected = [
        {"seq": message["seq"], "contact": index} | dict(leaves(contact))
        for message in messages
        for index, contact in enumerate(message["contacts"])
    ]
    assert [{name: one for name, one in row.items() if one is not None} for row in contacts] == expected
    expected = [
        (message["seq"], index, *now, *(np.array(now) - origin), *origin, status, share, stderr)
        for message in messages
        for index, (origin, now, status, share, stderr) in enumerate(
            zip(*(message["markers"] or {}).values(), strict=True)
        )
    ]
    assert [tuple(row.values()) for row in rows(tmp_path, "markers")] == expected


def test_every_value_of_the_message_has_a_column_with_its_description(tmp_path: Path) -> None:
    sink = opened(tmp_path)
    write(sink, range(1))
    sink.close()
    schema = pq.read_schema(tmp_path / "frames" / "part-00000.parquet")
    described = message_schema()["$defs"]["Contact"]["properties"]["depth_mm"]["description"]
    assert schema.field("contact_depth_mm").metadata[b"description"].decode() == described
    assert schema.metadata[b"schema"] == b"tactflow.frame/1"
    assert {b"tactflow", b"numpy", b"opencv", b"sensor"} <= set(schema.metadata)


def test_a_part_is_written_at_the_interval_and_can_be_read_while_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 50.0
    monkeypatch.setattr(parquet_module.time, "monotonic", lambda: now)
    sink = opened(tmp_path, flush=10)
    write(sink, range(3))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    now = 60.0
    write(sink, range(3, 4))
    write(sink, range(4, 6))
    assert [row["seq"] for row in rows(tmp_path, "frames")] == [0, 1, 2, 3]
    sink.close()
    assert [row["seq"] for row in rows(tmp_path, "frames")] == list(range(6))
    assert sink.counters() == {"frames": 6, "parts": 2}


def test_tables_are_replaced_or_added_to(tmp_path: Path) -> None:
    for settings, expected in (({}, [0, 1]), ({"append": True}, [0, 1, 0, 1]), ({"overwrite": True}, [0, 1])):
        sink = opened(tmp_path, **settings)
        write(sink, range(2))
        sink.close()
        assert [row["seq"] for row in rows(tmp_path, "frames")] == expected


def test_the_example_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed")
    sink = opened(tmp_path / "out" / "press")
    write(sink, range(8))
    sink.close()
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "recordings.md").read_text()
    exec("import pandas" + page.partition("```python\nimport pandas")[2].partition("```")[0], {})
    assert "contact_center_x" in capsys.readouterr().out


def test_a_run_puts_its_pipeline_and_calibration_into_every_table(tmp_path: Path) -> None:
    (tmp_path / "left.yaml").write_text("sensor: left\n")
    (tmp_path / "left.npz").write_bytes(b"arrays")
    pipeline = SimpleNamespace(settings={}, file=tmp_path / "no.yaml", calibration=tmp_path / "left.yaml")
    control: Any = SimpleNamespace(pipeline=pipeline, source=None)
    sink = Parquet(Parquet.Params(path=str(tmp_path / "calibrated")), "left", control)
    sink.open()
    write(sink, range(1))
    sink.close()
    _, seen = run(tmp_path, {"parquet": {"path": str(tmp_path / "out")}}, source=str(array(tmp_path, 12)))
    assert seen.exit == 0
    for name in TABLES:
        facts = pq.read_schema(tmp_path / "calibrated" / name / "part-00000.parquet").metadata
        assert facts[b"calibration.yaml"] == b"sensor: left\n"
        facts = pq.read_schema(tmp_path / "out" / name / "part-00000.parquet").metadata
        assert b"noise.npy" in facts[b"source"]
        assert b"preprocess" in facts[b"pipeline.yaml"]
    assert len(rows(tmp_path / "out", "frames")) == 12
