"""The CSV sink: a table that a spreadsheet opens, with the numbers of the message."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import orjson
import pytest

import tactflow
from tactflow.cli.main import main
from tactflow.engine.errors import StageError
from tactflow.message.columns import scalar_columns
from tactflow.message.result import encode_message
from tactflow.sinks.csv import Csv


@pytest.fixture(scope="module")
def results() -> list[tactflow.Result]:
    """A press on the simulated sensor, from before the contact until into it."""
    return list(tactflow.stream(source="sim:press?frames=40", settings={"sinks": {}}))


def opened(path: Path | str, **params: Any) -> Csv:
    sink = Csv(Csv.Params(path=str(path), **params))
    sink.open()
    return sink


def written(path: Path, results: list[tactflow.Result], **params: Any) -> list[dict[str, str]]:
    sink = opened(path, **params)
    for result in results:
        sink.write(result)
    sink.close()
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_cell_is_the_value_of_the_message(tmp_path: Path, results: list[tactflow.Result]) -> None:
    rows = written(tmp_path / "a.csv", results)
    assert len(rows) == len(results)
    assert {row["contact.area [px^2]"] == "" for row in rows} == {True, False}
    for row, result in zip(rows, results, strict=True):
        message = orjson.loads(encode_message(result))
        contact = message["contact"] or {"area": "", "center": ("", ""), "evidence": ""}
        assert row["seq"] == str(message["seq"])
        assert row["t [s]"] == str(message["t"])
        assert row["contact.area [px^2]"] == str(contact["area"])
        assert (row["contact.center.x [px]"], row["contact.center.y [px]"]) == tuple(
            map(str, contact["center"])
        )
        assert row["contact.evidence"] == contact["evidence"]
        assert row["skipped"] == "; ".join(f"{port}: {why}" for port, why in message["skipped"].items())


def test_lists_have_no_columns_and_names_are_those_of_the_message() -> None:
    headings = [column.heading for column in scalar_columns()]
    assert len(set(headings)) == len(headings)
    assert not [name for name in headings if "hull" in name or "covariance" in name or "markers" in name]
    assert {
        *("sensor", "seq", "t [s]", "size.width [px]", "flow.mean.x [px]", "flow.count"),
        *("contact.angle [degrees]", "contact.slope", "contact.ellipse.axes.major [px]"),
        *("contact.area_mm2 [mm^2]", "slip.speed [px/s]", "slip.speed_mm [mm/s]", "force.value.z [N]"),
        *("scale.mm_per_px.x [mm per px]", "pose.rotation.x [degrees]", "pose.stderr.x", "skipped"),
    } <= set(headings)


def test_details_and_what_no_stage_computes_have_no_columns() -> None:
    names = {column.name for column in scalar_columns(("force",), detail=False)}
    assert {"contact_area", "force_value_z", "skipped"} <= names
    assert not names & {"contact_confidence", "slip_slipping", "pose_status", "features_unit"}


def test_a_table_is_continued_after_its_last_whole_row(
    tmp_path: Path, results: list[tactflow.Result]
) -> None:
    path = tmp_path / "a.csv"
    written(path, results[:3])
    with path.open("ab") as file:
        file.write(b"main,3,0.0")
    rows = written(path, results[3:5], append=True)
    assert [row["seq"] for row in rows] == ["0", "1", "2", "3", "4"]


@pytest.mark.parametrize("content", ["seq,t\n1,2\n", "my notes"])
def test_a_file_with_other_columns_is_not_continued(tmp_path: Path, content: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(content)
    with pytest.raises(StageError, match="cannot be continued: its columns are not those of this run"):
        opened(path, append=True)
    assert path.read_text() == content


def test_a_run_adds_the_table_with_the_columns_of_its_stages(tmp_path: Path) -> None:
    out = tmp_path / "run.csv"
    words = ["run", "markerless", "--source", "sim:press?frames=30", "--quiet"]
    assert main([*words, "--set", "sinks={}", "--csv", str(out)]) == 0
    with out.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["seq"] for row in rows] == [str(seq) for seq in range(30)]
    assert "contact.area [px^2]" in rows[0]
    assert not [name for name in rows[0] if name.startswith(("slip", "pose", "features"))]


def test_standard_output_gets_the_header_and_each_row(
    capfdbinary: pytest.CaptureFixture[bytes], results: list[tactflow.Result]
) -> None:
    sink = opened("-")
    for result in results[:2]:
        sink.write(result)
    sink.close()
    first, *rows = capfdbinary.readouterr().out.decode().splitlines()
    assert first.startswith("sensor,seq,t [s],")
    assert [row.split(",")[1] for row in rows] == ["0", "1"]
